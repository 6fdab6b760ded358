"""Proposal distributions of particle filters: bootstrap, guided (conditioned on the measurement) and auxiliary."""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key

from jaxloc import _tree as tree
from jaxloc._linalg import matmul
from jaxloc.beliefs import Motion, Particles, Sensor
from jaxloc.beliefs.models import dtype_of, innovation, log_normal, mask_covariance
from jaxloc.beliefs.particles import NOTHING
from jaxloc.beliefs.square_root import cholesky, whiten
from jaxloc.poses import local, retract, tangent_dimension


class MotionNoise(eqx.Module):
    """Motion noise drawn in a prediction, for proposals that condition it on the measurement later.

    Attributes:
        centers: particles moved without noise.
        roots: square roots of the covariance of the motion's noise.
        normals: standard normal numbers of the draw: ``retract(center, root @ normal)`` are the particles.
        fresh: whether no measurement has been used since the draw.
    """

    centers: Any
    roots: Float[Array, "n d d"]
    normals: Float[Array, "n d"]
    fresh: Bool[Array, ""]


class Resampled(eqx.Module):
    """Particles after a conditional resampling.

    Attributes:
        particles: as many as before.
        ancestors: index of the particle that each came from.
        resampled: whether they were resampled; if not, each is its own ancestor.
    """

    particles: Particles
    ancestors: Int[Array, " n"]
    resampled: Bool[Array, ""]


class Weighted(eqx.Module):
    """Particles weighted by a measurement, not normalized.

    Attributes:
        particles: their total weight is the likelihood of the measurement.
        noise: of the motion, marked as used.
        choice: result of resampling, where the proposal resampled.
    """

    particles: Particles
    noise: MotionNoise | None
    choice: Resampled | None


class Sampled(eqx.Module):
    """Particles moved by the motion.

    Attributes:
        values: their new states.
        noise: of the motion, kept for `Proposal.weigh`.
        log_density: of the motion at the values, held fixed: its derivative is the score function.
    """

    values: Any
    noise: MotionNoise | None
    log_density: Float[Array, " n"]

    def where_finite(self, particles: Particles, noise: MotionNoise | None) -> tuple[Bool[Array, ""], "Sampled"]:
        """Moved particles, and those that did not move where the motion is not finite or overflows.

        Args:
            particles: before the motion.
            noise: placeholder of the noise of those that did not move.

        Returns:
            Whether all valid particles moved, and the particles.
        """
        drawn = None if self.noise is None else (self.noise.centers, self.noise.roots, self.noise.normals)
        good = tree.slots_within_range((self.values, drawn))
        choose = jax.vmap(tree.where)
        density = jnp.where(good & jnp.isfinite(self.log_density), self.log_density, 0.0)
        if self.noise is not None and noise is not None:
            noise = MotionNoise(*choose(good, drawn, (noise.centers, noise.roots, noise.normals)), self.noise.fresh)
        moved = Sampled(choose(good, self.values, particles.values), noise, density)
        return jnp.all(good | ~particles.valid), moved


class Proposal(eqx.Module):
    """How particles are sampled and weighted.

    Attributes:
        resamples_with_measurement: whether `weigh` resamples, instead of the filter before the prediction.
    """

    resamples_with_measurement: eqx.AbstractClassVar[bool]

    @abstractmethod
    def init_noise(self, values: Any) -> MotionNoise | None:
        """Placeholder noise of initial particles."""

    @abstractmethod
    def draw(self, motion: Motion, values: Any, control: Any, *, key: Key[Array, ""]) -> Sampled:
        """Particles moved by the motion."""

    @abstractmethod
    def weigh(
        self,
        particles: Particles,
        noise: MotionNoise | None,
        observation: "Observation",
        resample: Callable[[Particles], Resampled],
    ) -> Weighted:
        """Particles weighted by the observation, possibly moved by it."""


class Observation(eqx.Module):
    """A measurement with its sensor model.

    Attributes:
        sensor: the model.
        measurement: the measurement.
        valid: mask of the measurement.
        pathwise: whether derivatives pass through the particles' values; else through the score function.
    """

    sensor: Sensor
    measurement: Any
    valid: Bool[Array, "*m"]
    pathwise: bool = eqx.field(static=True)

    def log_likelihood(self, values: Any) -> Float[Array, " n"]:
        """Log likelihood at each particle; `NOTHING` where it is NaN, or beyond the range of numbers."""
        found = jax.vmap(lambda value: self.sensor.log_prob(value, self.measurement, self.valid))(values)
        good = (found > max(NOTHING, -tree.largest(found.dtype))) & (found < jnp.inf)
        return jnp.where(good, jnp.where(good, found, 0.0), NOTHING)


class Bootstrap(Proposal):
    """Particles sampled from the motion (`Motion.perturb`), weighted by the likelihood (`Sensor.log_prob`).

    References:
        Gordon, Salmond, Smith, 1993 [R-7].
    """

    resamples_with_measurement = False

    def init_noise(self, values: Any) -> None:
        """None is needed."""
        return None

    def draw(self, motion: Motion, values: Any, control: Any, *, key: Key[Array, ""]) -> Sampled:
        """Particles moved by the motion."""
        normals = _normals(motion.noise_dimension(_first(values)), values, key)
        moved = jax.vmap(lambda value, normal: motion.perturb(value, control, normal))(values, normals)
        density = jax.vmap(lambda value, end: motion.log_prob(value, control, end))(values, lax.stop_gradient(moved))
        return Sampled(moved, None, density)

    def weigh(self, particles: Particles, noise: None, observation: Observation, resample: Any) -> Weighted:
        """Particles weighted by the likelihood."""
        return Weighted(_add_log_likelihood(particles, observation.log_likelihood(particles.values)), None, None)


class Guided(Proposal):
    """Particles sampled from ``p(x' | x, z)``, with the sensor linearized at each moved particle.

    Per particle, the noise of the motion ``N(0, L L^T)`` is conditioned on the measurement by one Kalman update about
    the moved particle, and the normal numbers of `draw` are transformed by its root. The weight is the predictive
    likelihood of the measurement, times a correction of the linearization, so that weights are exact for any sensor.

    Requires tangent noise: a `Motion` with `covariance`, whose `perturb` is not overridden.

    References:
        Doucet, Godsill, Andrieu, "On sequential Monte Carlo sampling methods for Bayesian filtering", Statistics and
        Computing 2000, section II.D; the root of the update: Andrews, "A square root formulation of the Kalman
        covariance equations", AIAA J. 1968.
    """

    resamples_with_measurement = False

    def init_noise(self, values: Any) -> MotionNoise:
        """Placeholder noise, marked as used."""
        return _unused_noise(values)

    def draw(self, motion: Motion, values: Any, control: Any, *, key: Key[Array, ""]) -> Sampled:
        """Particles moved by the motion, with its noise."""
        return _sample(motion, values, control, key)

    def weigh(self, particles: Particles, noise: MotionNoise, observation: Observation, resample: Any) -> Weighted:
        """Particles sampled given the measurement, weighted by its predictive likelihood."""
        particles = _without_score(particles, noise, observation)
        return Weighted(
            _move_conditioned(particles, noise, _conditioned(noise, observation), observation), _mark_used(noise), None
        )


class Auxiliary(Proposal):
    """Auxiliary particle filter: ancestors are resampled by the predicted likelihood of the measurement.

    First-stage weights are those of the particles times the likelihood at the moved particle without noise (or, guided,
    times the predictive likelihood, which makes the filter fully adapted where the sensor is linear).

    Requires tangent noise: a `Motion` with `covariance`, whose `perturb` is not overridden.

    Attributes:
        guided: sample from `Guided` instead of the motion.

    References:
        Pitt and Shephard, "Filtering via simulation: auxiliary particle filters", JASA 1999.
    """

    guided: bool = eqx.field(static=True, default=False)

    resamples_with_measurement = True

    def init_noise(self, values: Any) -> MotionNoise:
        """Placeholder noise, marked as used."""
        return _unused_noise(values)

    def draw(self, motion: Motion, values: Any, control: Any, *, key: Key[Array, ""]) -> Sampled:
        """Particles moved by the motion, with its noise."""
        return _sample(motion, values, control, key)

    def weigh(
        self,
        particles: Particles,
        noise: MotionNoise,
        observation: Observation,
        resample: Callable[[Particles], Resampled],
    ) -> Weighted:
        """Particles resampled by first-stage weights, sampled again, with second-stage weights."""
        particles = _without_score(particles, noise, observation)
        conditioned = _conditioned(noise, observation) if self.guided else None
        ahead = observation.log_likelihood(noise.centers) if conditioned is None else conditioned.log_likelihood
        ahead = jnp.where(noise.fresh, ahead, 0.0)
        carried = (particles.values, noise.centers, noise.roots, conditioned, ahead)
        choice = resample(_add_log_likelihood(Particles(carried, particles.log_weights, particles.valid), ahead))
        values, centers, roots, conditioned, ahead = choice.particles.values
        log_weights = jnp.maximum(choice.particles.log_weights - ahead, NOTHING)
        particles = Particles(values, log_weights, choice.particles.valid)
        noise = MotionNoise(centers, roots, noise.normals, noise.fresh)
        if conditioned is not None:
            return Weighted(_move_conditioned(particles, noise, conditioned, observation), _mark_used(noise), choice)
        drawn = jax.vmap(lambda c, r, n: retract(c, matmul(r, n)))(centers, roots, noise.normals)
        particles = _replace_values(particles, noise, drawn, observation)
        return Weighted(
            _add_log_likelihood(particles, observation.log_likelihood(particles.values)), _mark_used(noise), choice
        )


def score(log_density: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Zeros with the derivative of a log density: ``f - stop_gradient(f)``, at no cost without differentiation.

    Example:
        >>> import jax, jaxloc as jl
        >>> value, slope = jax.value_and_grad(lambda x: jl.filters.proposals.score(x * x))(3.0)
        >>> float(value), float(slope)
        (0.0, 6.0)
    """
    return _score(log_density)


@jax.custom_jvp
def _score(log_density: Array) -> Array:
    return jnp.zeros_like(log_density)


@_score.defjvp
def _score_jvp(primals, tangents):
    return jnp.zeros_like(primals[0]), tangents[0]


class _Conditioned(eqx.Module):
    """The noise of one particle given the measurement, by a linear update about the center."""

    log_likelihood: Array
    mean: Array
    root: Array
    residual: Array
    jacobian: Array
    mask: Array
    covariance: Array


def _conditioned(noise: MotionNoise, observation: Observation) -> _Conditioned:
    return jax.vmap(lambda center, root: _condition(observation, center, root))(noise.centers, noise.roots)


def _condition(observation: Observation, center: Any, root: Array) -> _Conditioned:
    expected, jacobian = observation.sensor.linearize(center, observation.measurement)
    residual, mask = innovation(expected, observation.measurement, observation.valid)
    covariance = mask_covariance(observation.sensor.covariance(center, observation.measurement), mask)
    jacobian = jnp.where(mask[:, None], jacobian, 0.0)
    across = matmul(jacobian, root)  # (H L): of the measurement by the normal numbers
    noise_root = cholesky(covariance)
    total = matmul(across, across.T) + covariance
    total_root = cholesky(total)
    white = whiten(total_root, across)
    mean = matmul(root, matmul(white.T, whiten(total_root, residual)))
    # Andrews: L (I - A^T s^-T (s + r)^-1 A), a root of L L^T - K S K^T without a difference of covariances.
    narrowed = root - matmul(root, matmul(white.T, whiten(total_root + noise_root, across)))
    log_likelihood = log_normal(residual, total, mask)
    return _Conditioned(log_likelihood, mean, narrowed, residual, jacobian, mask, covariance)


def _move_conditioned(
    particles: Particles, noise: MotionNoise, conditioned: _Conditioned, observation: Observation
) -> Particles:
    def move(center, mean, root, normal):
        delta = mean + matmul(root, normal)
        return retract(center, delta), delta

    moved, deltas = jax.vmap(move)(noise.centers, conditioned.mean, conditioned.root, noise.normals)
    particles = _replace_values(particles, noise, moved, observation)

    def linear(c, delta):
        return log_normal(c.residual - matmul(c.jacobian, delta), c.covariance, c.mask)

    # Predictive likelihood over the linearized likelihood at the sample, for which the exact one stands in.
    ratio = conditioned.log_likelihood - jax.vmap(linear)(conditioned, deltas)
    ratio = ratio if observation.pathwise else lax.stop_gradient(ratio)
    found = observation.log_likelihood(particles.values) + jnp.where(noise.fresh, ratio, 0.0)
    return _add_log_likelihood(particles, found)


def _log_density(noise: MotionNoise, values: Any) -> Array:
    """Log density of the motion whose noise is given, at values held fixed."""

    def one(center, root, value):
        mask = jnp.ones(root.shape[:1], bool)
        return log_normal(local(center, value), matmul(root, root.T), mask)

    return jax.vmap(one)(noise.centers, noise.roots, lax.stop_gradient(values))


def _without_score(particles: Particles, noise: MotionNoise, observation: Observation) -> Particles:
    """Particles without the score of the samples that are about to be replaced."""
    if observation.pathwise:
        return particles
    scores = jnp.where(noise.fresh, score(_log_density(noise, particles.values)), 0.0)
    return Particles(particles.values, particles.log_weights - scores, particles.valid)


def _replace_values(particles: Particles, noise: MotionNoise, values: Any, observation: Observation) -> Particles:
    """Particles with new values, and the score of these samples in their weights."""
    if observation.pathwise:
        return Particles(tree.where(noise.fresh, values, particles.values), particles.log_weights, particles.valid)
    values = lax.stop_gradient(values)
    scores = jnp.where(noise.fresh, score(_log_density(noise, values)), 0.0)
    return Particles(tree.where(noise.fresh, values, particles.values), particles.log_weights + scores, particles.valid)


def _add_log_likelihood(particles: Particles, log_likelihood: Array) -> Particles:
    log_weights = jnp.maximum(particles.log_weights + log_likelihood, NOTHING)
    return Particles(particles.values, jnp.where(particles.valid, log_weights, NOTHING), particles.valid)


def _sample(motion: Motion, values: Any, control: Any, key: Array) -> Sampled:
    dimension = tangent_dimension(_first(values))
    normals = _normals(dimension, values, key)

    def move(value, normal):
        center, root = motion.move(value, control), cholesky(motion.covariance(value, control))
        return retract(center, matmul(root, normal)), center, root

    moved, centers, roots = jax.vmap(move)(values, normals)
    noise = MotionNoise(centers, roots, normals, jnp.ones((), bool))
    return Sampled(moved, noise, _log_density(noise, moved))


def _unused_noise(values: Any) -> MotionNoise:
    size, dimension = jax.tree.leaves(values)[0].shape[0], tangent_dimension(_first(values))
    zeros = jnp.zeros((size, dimension), dtype_of(values))
    return MotionNoise(values, jnp.zeros((size, dimension, dimension), zeros.dtype), zeros, jnp.zeros((), bool))


def _mark_used(noise: MotionNoise) -> MotionNoise:
    return MotionNoise(noise.centers, noise.roots, noise.normals, jnp.zeros((), bool))


def _normals(dimension: int, values: Any, key: Array) -> Array:
    """Standard normal numbers of all particles in one draw: a key for each would cost more than the numbers."""
    size = jax.tree.leaves(values)[0].shape[0]
    return jax.random.normal(key, (size, dimension), dtype_of(values))


def _first(values: Any) -> Any:
    return jax.tree.map(lambda leaf: leaf[0], values)
