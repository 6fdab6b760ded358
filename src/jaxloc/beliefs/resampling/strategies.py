"""Resampling strategies of particle filters."""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Int, Key

from jaxloc._xla import shard_like
from jaxloc.beliefs.particles import NOTHING, Particles, finite_log_weights
from jaxloc.beliefs.resampling.indices import multinomial, residual, soft, stratified, systematic
from jaxloc.beliefs.resampling.optimal_transport import optimal_transport


class Resampled(eqx.Module):
    """Particles after resampling.

    Attributes:
        particles: as many as before; the total weight is unchanged.
        ancestors: index of the particle that each is a copy of.
    """

    particles: Particles
    ancestors: Int[Array, " n"]


class Resampling(eqx.Module):
    """A resampling strategy.

    Attributes:
        pathwise: whether its gradient passes through the particles, instead of the score function of the draws.
    """

    pathwise: eqx.AbstractClassVar[bool]

    @abstractmethod
    def resample(self, particles: Particles, *, key: Key[Array, ""], count: Int[Array, ""] | None = None) -> Resampled:
        """Particles of (nearly) equal weights for the same density.

        Args:
            particles: weighted.
            key: random key.
            count: number of slots to fill; None for all.
        """


class Systematic(Resampling):
    """`systematic` draws; the weights carry the gradient of the choice (see `by_ancestors`)."""

    pathwise = False

    def resample(self, particles: Particles, *, key: Key[Array, ""], count: Any = None) -> Resampled:
        """Draws; see `Resampling`."""
        return by_ancestors(systematic, particles, key=key, count=count)


class Stratified(Resampling):
    """`stratified` draws; the weights carry the gradient of the choice (see `by_ancestors`)."""

    pathwise = False

    def resample(self, particles: Particles, *, key: Key[Array, ""], count: Any = None) -> Resampled:
        """Draws; see `Resampling`."""
        return by_ancestors(stratified, particles, key=key, count=count)


class Multinomial(Resampling):
    """`multinomial` draws; the weights carry the gradient of the choice (see `by_ancestors`)."""

    pathwise = False

    def resample(self, particles: Particles, *, key: Key[Array, ""], count: Any = None) -> Resampled:
        """Draws; see `Resampling`."""
        return by_ancestors(multinomial, particles, key=key, count=count)


class Residual(Resampling):
    """`residual` draws; the weights carry the gradient of the choice (see `by_ancestors`)."""

    pathwise = False

    def resample(self, particles: Particles, *, key: Key[Array, ""], count: Any = None) -> Resampled:
        """Draws; see `Resampling`."""
        return by_ancestors(residual, particles, key=key, count=count)


class Soft(Resampling):
    """`soft` resampling: a low-variance, biased gradient through the weights."""

    alpha: float = eqx.field(static=True, default=0.5)

    pathwise = True

    def resample(self, particles: Particles, *, key: Key[Array, ""], count: Any = None) -> Resampled:
        """Draws from the mixture; see `Resampling`."""
        _refuse_count(self, count)
        ancestors, fresh = soft(key, finite_log_weights(particles), particles.size, alpha=self.alpha)
        moved = Particles(particles.take(ancestors), jnp.maximum(fresh + particles.log_total, NOTHING))
        return _placed(Resampled(moved, ancestors), particles)


class OptimalTransport(Resampling):
    """`optimal_transport` of the particles: deterministic, biased combinations; n^2 time and memory.

    It has no ancestors: particle i stays in slot i.
    """

    epsilon: float = eqx.field(static=True, default=0.1)
    iterations: int = eqx.field(static=True, default=30)

    pathwise = True

    def resample(self, particles: Particles, *, key: Key[Array, ""], count: Any = None) -> Resampled:
        """Transports the particles; see `Resampling`."""
        _refuse_count(self, count)
        moved = optimal_transport(
            particles.values, finite_log_weights(particles), epsilon=self.epsilon, iterations=self.iterations
        )
        level = jnp.broadcast_to(particles.log_mean_weight, (particles.size,))
        return Resampled(Particles(moved, level), jnp.arange(particles.size, dtype=jnp.int32))


def by_ancestors(
    scheme: Callable[..., Int[Array, " n"]],
    particles: Particles,
    *,
    key: Key[Array, ""],
    count: Int[Array, ""] | None = None,
) -> Resampled:
    """Copies of sampled ancestors, whose equal weights carry the score-function gradient of the sampling.

    The log weight of a copy is ``log w_a - stop(log w_a)`` plus a constant: equal for all, with the score of the choice
    of a as derivative. It adds no bias to that of the particle filter. The gradient of the log likelihood has the
    expectation of the exact score up to terms that vanish with the number of particles, at a variance that grows with
    the length of the recording.

    Args:
        scheme: `systematic`, `stratified`, `multinomial` or `residual`.
        particles: weighted.
        key: random key.
        count: number of slots to fill; the others become invalid. None for all.

    References:
        Scibior and Wood, "Differentiable particle filtering without modifying the forward pass", 2021, algorithm 1.
    """
    log_weights = finite_log_weights(particles)
    ancestors = scheme(key, lax.stop_gradient(log_weights), particles.size, count=count)
    valid = None if count is None else jnp.arange(particles.size, dtype=jnp.int32) < count
    chosen = log_weights.at[ancestors].get(mode="promise_in_bounds")
    filled = jnp.asarray(particles.size if count is None else count).astype(chosen.dtype)
    level = lax.stop_gradient(particles.log_total) - jnp.log(filled)
    fresh = chosen - lax.stop_gradient(chosen) + level
    fresh = fresh if valid is None else jnp.where(valid, fresh, NOTHING)
    return _placed(Resampled(Particles(particles.take(ancestors), fresh, valid), ancestors), particles)


def _placed(resampled: Resampled, particles: Particles) -> Resampled:
    """Resampled particles with the sharding of the given ones; the compiler would gather them on each device."""
    return shard_like(resampled, (particles, particles.log_weights))


def _refuse_count(strategy: Resampling, count: Any) -> None:
    if count is not None:
        raise ValueError(f"{type(strategy).__name__} fills every slot; resample to a count with Systematic().")
