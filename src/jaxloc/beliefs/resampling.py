"""From weighted particles to equal ones: draws in linear time without a search, and differentiable ways."""

import math
from abc import abstractmethod
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.experimental.shard_alike import shard_alike
from jaxtyping import Array, Float, Int, Key

from jaxloc.beliefs.fixed_point import Boundaries, boundaries, bounded_values
from jaxloc.beliefs.particles import NOTHING, Particles, finite_log_weights
from jaxloc.beliefs.transport import optimal_transport

_ROUNDING = 1.2e-7  # of single precision


def systematic(
    key: Key[Array, ""], log_weights: Float[Array, " m"], n: int, *, count: Int[Array, ""] | None = None
) -> Int[Array, " n"]:
    """Ancestors at the points ``(j + u) / n`` of the cumulative weights, one random number for all.

    The number of copies of a particle is ``n w`` rounded down or up, and ``n w`` on average. The cumulative sum is in
    integers: exact for millions of particles, and the same however they are spread over devices.

    Args:
        key: random key.
        log_weights: of any common offset; a weight that is no finite number is zero; where all are zero, all are equal.
        n: number of ancestors drawn.
        count: draw only so many, the rest of the ancestors is meaningless; None for n.

    Returns:
        Indices in ascending order; they carry no gradient (see `Systematic` for the weights that do).

    References:
        Carpenter, Clifford, Fearnhead, "Improved particle filter for nonlinear problems", IEE Proc. 1999 [R-10]; Douc,
        Cappe, Moulines, "Comparison of resampling schemes for particle filtering", ISPA 2005.

    Example:
        >>> import jax, jax.numpy as jnp, jaxloc as jl
        >>> log_weights = jnp.log(jnp.array([0.5, 0.0, 0.25, 0.25]))
        >>> jl.beliefs.resampling.systematic(jax.random.key(0), log_weights, 4).tolist()
        [0, 0, 2, 3]
    """
    bounds = boundaries(bounded_values(log_weights), _count(n, count))
    offset = jax.random.bits(key, (), jnp.uint32)
    return _ancestors(bounds.whole + (bounds.fraction > offset).astype(jnp.int32), bounds.last, n)


def stratified(
    key: Key[Array, ""], log_weights: Float[Array, " m"], n: int, *, count: Int[Array, ""] | None = None
) -> Int[Array, " n"]:
    """Ancestors at the points ``(j + u_j) / n`` of the cumulative weights, a random number for each.

    Args:
        key: random key.
        log_weights: as for `systematic`.
        n: number of ancestors drawn.
        count: draw only so many.

    Returns:
        Indices in ascending order.

    References:
        Kitagawa, "Monte Carlo filter and smoother for non-Gaussian nonlinear state space models", JCGS 1996 [R-10].

    Example:
        >>> import jax, jax.numpy as jnp, jaxloc as jl
        >>> jl.beliefs.resampling.stratified(jax.random.key(0), jnp.zeros(4), 4).tolist()
        [0, 1, 2, 3]
    """
    bounds = boundaries(bounded_values(log_weights), _count(n, count))
    offsets = jax.random.bits(key, (n,), jnp.uint32)
    offset = offsets.at[jnp.clip(bounds.whole, 0, n - 1)].get(mode="promise_in_bounds")
    return _ancestors(bounds.whole + (bounds.fraction > offset).astype(jnp.int32), bounds.last, n)


def multinomial(
    key: Key[Array, ""], log_weights: Float[Array, " m"], n: int, *, count: Int[Array, ""] | None = None
) -> Int[Array, " n"]:
    """Independent ancestors, each particle with its weight's probability.

    Uniform points are drawn as (cell, fraction) of n cells; how many lie in each cell is counted, and those before each
    boundary are compared one by one within its own cell, which holds about one: no sort and no search.

    Args:
        key: random key.
        log_weights: as for `systematic`.
        n: number of ancestors drawn.
        count: draw only so many.

    Returns:
        Indices in ascending order (shuffle them where order matters).

    References:
        Gordon, Salmond, Smith, 1993 [R-10].

    Example:
        >>> import jax, jax.numpy as jnp, jaxloc as jl
        >>> log_weights = jnp.log(jnp.array([0.5, 0.0, 0.5]))
        >>> bool(jnp.any(jl.beliefs.resampling.multinomial(jax.random.key(0), log_weights, 100) == 1))
        False
    """
    bounds = boundaries(bounded_values(log_weights), _count(n, count))
    return _ancestors(_points_below(key, bounds, n, _count(n, count)), bounds.last, n)


def residual(
    key: Key[Array, ""], log_weights: Float[Array, " m"], n: int, *, count: Int[Array, ""] | None = None
) -> Int[Array, " n"]:
    """The whole part of ``n w`` copies of each particle, and independent draws from what remains.

    Args:
        key: random key.
        log_weights: as for `systematic`.
        n: number of ancestors drawn.
        count: draw only so many.

    Returns:
        Indices in ascending order.

    References:
        Liu and Chen, "Sequential Monte Carlo methods for dynamic systems", JASA 1998 [R-10].

    Example:
        >>> import jax, jax.numpy as jnp, jaxloc as jl
        >>> log_weights = jnp.log(jnp.array([0.5, 0.125, 0.375]))
        >>> jl.beliefs.resampling.residual(jax.random.key(0), log_weights, 8).tolist()
        [0, 0, 0, 0, 1, 2, 2, 2]
    """
    total = _count(n, count)
    bounds = boundaries(bounded_values(log_weights), total)
    # A share that is whole but for rounding is whole.
    copies = jnp.floor(bounds.share * (1.0 + 4.0 * _ROUNDING)).astype(jnp.int32)
    missing = jnp.maximum(total - jnp.sum(copies, dtype=jnp.int32), 0)
    rest = boundaries(jnp.maximum(bounds.share - copies.astype(jnp.float32), 0.0), missing)
    drawn = _points_below(key, rest, n, missing)
    return _ancestors(jnp.cumsum(copies, axis=0, dtype=jnp.int32) + drawn, bounds.last, n)


def soft(
    key: Key[Array, ""],
    log_weights: Float[Array, " m"],
    n: int,
    *,
    alpha: float = 0.5,
    scheme: Callable[..., Int[Array, " n"]] = systematic,
) -> tuple[Int[Array, " n"], Float[Array, " n"]]:
    """Ancestors from the mixture ``q = a w + (1 - a) / m``, with log weights ``log(w / q / n)`` that carry gradients.

    What is biased: the gradient. Weights and estimates are right (on average, with more variance than `systematic`),
    and so is the likelihood; but no derivative passes through the choice of ancestors, so that the score is wrong by
    a part that shrinks as ``a`` goes to zero, where nothing is resampled.

    Args:
        key: random key.
        log_weights: as for `systematic`.
        n: number of ancestors drawn.
        alpha: part of the weights in the mixture, in (0, 1].
        scheme: how the ancestors are drawn.

    Returns:
        Indices, and the log weights of the drawn particles.

    References:
        Karkus, Hsu, Lee, "Particle filter networks", CoRL 2018, eq. 5.

    Example:
        >>> import jax, jax.numpy as jnp, jaxloc as jl
        >>> log_weights = jnp.log(jnp.array([0.5, 0.3, 0.2]))
        >>> indices, fresh = jl.beliefs.resampling.soft(jax.random.key(0), log_weights, 1000)
        >>> bool(jnp.abs(jnp.sum(jnp.exp(fresh)) - 1.0) < 0.02)
        True
    """
    if not 0.0 < alpha <= 1.0:
        raise ValueError(f"soft resampling needs 0 < alpha <= 1; it got {alpha}.")
    normal = Particles(log_weights, log_weights).normalize().log_weights
    there = normal > 0.5 * NOTHING
    uniform = -jnp.log(jnp.maximum(jnp.sum(there), 1).astype(normal.dtype)) + math.log(max(1.0 - alpha, 1e-30))
    mixed = jnp.where(there, jnp.logaddexp(jnp.where(there, normal, 0.0) + math.log(alpha), uniform), NOTHING)
    indices = scheme(key, mixed, n)
    fresh = jnp.where(there, normal - mixed, NOTHING)
    return indices, fresh.at[indices].get(mode="promise_in_bounds") - math.log(n)


class Resampled(eqx.Module):
    """Particles after resampling.

    Attributes:
        particles: as many as before; their log weights keep the total that they had.
        ancestors: which particle each was.
    """

    particles: Particles
    ancestors: Int[Array, " n"]


class Resampling(eqx.Module):
    """How a filter resamples.

    Attributes:
        pathwise: whether its gradient is meant to pass along the particles, rather than by the score of the draws.
    """

    pathwise: eqx.AbstractClassVar[bool]

    @abstractmethod
    def resample(self, particles: Particles, *, key: Key[Array, ""], count: Int[Array, ""] | None = None) -> Resampled:
        """Particles of nearly equal weights for the same density.

        Args:
            particles: weighted.
            key: random key.
            count: how many of the places to fill; None for all of them.
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
    """`soft` resampling: a gradient of little variance through the weights, which is biased."""

    alpha: float = eqx.field(static=True, default=0.5)

    pathwise = True

    def resample(self, particles: Particles, *, key: Key[Array, ""], count: Any = None) -> Resampled:
        """Draws from the mixture; see `Resampling`."""
        _refuse_count(self, count)
        ancestors, fresh = soft(key, finite_log_weights(particles), particles.size, alpha=self.alpha)
        moved = Particles(particles.take(ancestors), jnp.maximum(fresh + particles.log_total, NOTHING))
        return _placed(Resampled(moved, ancestors), particles)


class OptimalTransport(Resampling):
    """`optimal_transport` of the cloud: no draws, particles that are blends and biased; n^2 time and memory.

    It has no ancestors: particle i stands at place i.
    """

    epsilon: float = eqx.field(static=True, default=0.1)
    iterations: int = eqx.field(static=True, default=30)

    pathwise = True

    def resample(self, particles: Particles, *, key: Key[Array, ""], count: Any = None) -> Resampled:
        """Transports the cloud; see `Resampling`."""
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
    """Copies of drawn ancestors, whose equal weights carry the gradient of having been drawn.

    The log weight of a copy is ``log w_a - stop(log w_a)`` and the common level. Its value is equal for all; its
    derivative is the score of the choice of a. What is biased: nothing but what the particle filter itself is. The
    gradient of the log likelihood has the expectation of the exact score up to terms that vanish with the number of
    particles, at a variance that grows with the length of the recording.

    Args:
        scheme: `systematic` or one of its kin.
        particles: weighted.
        key: random key.
        count: how many of the places to fill; the others become invalid. None for all.

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
    """Resampled particles on the devices that hold the given ones; compilers would gather them on each."""
    if jax.device_count() == 1:
        return resampled
    like = Resampled(particles, particles.log_weights)
    return jax.tree.map(lambda new, old: shard_alike(new, old)[0], resampled, like)


def _count(n: int, count: Array | None) -> Array:
    return jnp.asarray(n, jnp.int32) if count is None else jnp.clip(count, 1, n).astype(jnp.int32)


def _refuse_count(strategy: Resampling, count: Any) -> None:
    if count is not None:
        raise ValueError(f"{type(strategy).__name__} fills every place; resample to a count with Systematic().")


def _ancestors(below: Array, last: Array, n: int) -> Array:
    """For each of n points the number of boundaries at or before it: the particle in whose share it lies.

    Args:
        below: for each particle how many points lie before the end of its share.
        last: the last particle of any weight.
        n: number of points.
    """
    ends = jnp.zeros(n + 1, jnp.int32).at[jnp.clip(below, 0, n)].add(1, mode="promise_in_bounds")
    return jnp.minimum(jnp.cumsum(ends[:n], axis=0, dtype=jnp.int32), last)


def _points_below(key: Array, bounds: Boundaries, n: int, count: Array) -> Array:
    """How many of `count` independent uniform points lie before each boundary."""
    key_cell, key_fraction = jax.random.split(key)
    cells = jax.random.randint(key_cell, (n,), 0, jnp.maximum(count, 1), jnp.int32)
    used = (jnp.arange(n, dtype=jnp.int32) < count).astype(jnp.int32)
    load = jnp.zeros(n + 1, jnp.int32).at[cells].add(used, mode="promise_in_bounds")
    first = jnp.cumsum(load, axis=0, dtype=jnp.int32) - load
    fractions = jax.random.bits(key_fraction, (n,), jnp.uint32)
    cell = jnp.clip(bounds.whole, 0, n)
    cell_first, cell_load = (x.at[cell].get(mode="promise_in_bounds") for x in (first, load))

    def compare(carry):
        place, found = carry
        point = fractions.at[jnp.minimum(cell_first + place, n - 1)].get(mode="promise_in_bounds")
        return place + 1, found + ((place < cell_load) & (point < bounds.fraction)).astype(jnp.int32)

    most = jnp.max(load)
    start = (jnp.zeros((), jnp.int32), cell_first)
    return lax.while_loop(lambda carry: carry[0] < most, compare, start)[1]
