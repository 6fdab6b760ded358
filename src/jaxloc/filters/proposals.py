"""Where a particle filter looks for the next state: along the motion, at what was measured, or after a look ahead."""

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


class Draft(eqx.Module):
    """How the particles of a prediction came about, for proposals that improve them once there is a measurement.

    Attributes:
        centers: particles moved without noise.
        roots: square roots of the covariance of the motion's noise.
        normals: the standard normal numbers that were used: ``retract(center, root @ normal)`` are the particles.
        fresh: whether no measurement has been used since.
    """

    centers: Any
    roots: Float[Array, "n d d"]
    normals: Float[Array, "n d"]
    fresh: Bool[Array, ""]


class Choice(eqx.Module):
    """Particles after a conditional resampling.

    Attributes:
        particles: as many as before.
        ancestors: where each came from.
        resampled: whether they were drawn; if not, each is its own ancestor.
    """

    particles: Particles
    ancestors: Int[Array, " n"]
    resampled: Bool[Array, ""]


class Weighed(eqx.Module):
    """Particles with the measurement in their weights, not normalized.

    Attributes:
        particles: whose total weight is the likelihood of the measurement.
        draft: after its use.
        choice: of ancestors, where the proposal resampled by itself.
    """

    particles: Particles
    draft: Draft | None
    choice: Choice | None


class Drawn(eqx.Module):
    """Particles moved by the motion.

    Attributes:
        values: where they went.
        draft: what is kept for `Proposal.weigh`.
        log_density: of the motion at the values, held fixed: its derivative is the score of the draws.
    """

    values: Any
    draft: Draft | None
    log_density: Float[Array, " n"]


class Proposal(eqx.Module):
    """How particles are drawn and weighed."""

    looks_ahead: eqx.AbstractClassVar[bool]

    @abstractmethod
    def begin(self, values: Any) -> Draft | None:
        """What is kept beside particles that no motion has made."""

    @abstractmethod
    def draw(self, motion: Motion, values: Any, control: Any, *, key: Key[Array, ""]) -> Drawn:
        """Particles moved by the motion."""

    @abstractmethod
    def weigh(
        self, particles: Particles, draft: Draft | None, reading: "Reading", resample: Callable[[Particles], Choice]
    ) -> Weighed:
        """Particles weighed by the reading, perhaps moved by it."""


class Reading(eqx.Module):
    """A sensor and what it read.

    Attributes:
        sensor: the model.
        measurement: what was read.
        valid: of it, what counts.
        pathwise: whether derivatives pass through the places of the particles; else through their density.
    """

    sensor: Sensor
    measurement: Any
    valid: Bool[Array, "*m"]
    pathwise: bool = eqx.field(static=True)

    def log_likelihood(self, values: Any) -> Float[Array, " n"]:
        """Of the reading at each particle; `NOTHING` where it is no number or zero."""
        found = jax.vmap(lambda value: self.sensor.log_prob(value, self.measurement, self.valid))(values)
        good = (found > NOTHING) & (found < jnp.inf)
        return jnp.where(good, jnp.where(good, found, 0.0), NOTHING)


class Bootstrap(Proposal):
    """Particles drawn by the motion (`Motion.perturb`), weighed by the likelihood (`Sensor.log_prob`).

    References:
        Gordon, Salmond, Smith, 1993 [R-7].
    """

    looks_ahead = False

    def begin(self, values: Any) -> None:
        """Nothing is kept."""
        return None

    def draw(self, motion: Motion, values: Any, control: Any, *, key: Key[Array, ""]) -> Drawn:
        """Particles moved by the motion."""
        normals = _normals(motion.noise_dimension(_first(values)), values, key)
        moved = jax.vmap(lambda value, normal: motion.perturb(value, control, normal))(values, normals)
        density = jax.vmap(lambda value, end: motion.log_prob(value, control, end))(values, lax.stop_gradient(moved))
        return Drawn(moved, None, density)

    def weigh(self, particles: Particles, draft: None, reading: Reading, resample: Any) -> Weighed:
        """Particles weighed by the likelihood."""
        return Weighed(_weighed(particles, reading.log_likelihood(particles.values)), None, None)


class Guided(Proposal):
    """Particles drawn from ``p(x' | x, z)`` for a sensor that is linear about each moved particle.

    Per particle, the noise of the motion ``N(0, L L^T)`` is conditioned on the measurement by one Kalman update about
    the moved particle, and the numbers that `draw` used are sent through its root once more. The weight is the
    predictive likelihood of the measurement, times what linearizing missed, so that any sensor is weighed exactly.

    It needs tangent noise: a `Motion` with `covariance`, whose `perturb` is not overridden.

    References:
        Doucet, Godsill, Andrieu, "On sequential Monte Carlo sampling methods for Bayesian filtering", Statistics and
        Computing 2000, section II.D; the root of the update: Andrews, "A square root formulation of the Kalman
        covariance equations", AIAA J. 1968.
    """

    looks_ahead = False

    def begin(self, values: Any) -> Draft:
        """A draft that is used up."""
        return _no_draft(values)

    def draw(self, motion: Motion, values: Any, control: Any, *, key: Key[Array, ""]) -> Drawn:
        """Particles moved by the motion, and how."""
        return _drafted(motion, values, control, key)

    def weigh(self, particles: Particles, draft: Draft, reading: Reading, resample: Any) -> Weighed:
        """Particles moved towards the measurement, weighed by its predictive likelihood."""
        particles = _forget(particles, draft, reading)
        return Weighed(_guide(particles, draft, _conditioned(draft, reading), reading), _used(draft), None)


class Auxiliary(Proposal):
    """Ancestors chosen by how well the measurement fits where they lead: the measurement is known before resampling.

    First-stage weights are those of the particles times the likelihood at the moved particle without noise (or, guided,
    times the predictive likelihood, which makes the filter fully adapted where the sensor is linear).

    It needs tangent noise: a `Motion` with `covariance`, whose `perturb` is not overridden.

    Attributes:
        guided: draw from `Guided` instead of the motion.

    References:
        Pitt and Shephard, "Filtering via simulation: auxiliary particle filters", JASA 1999.
    """

    guided: bool = eqx.field(static=True, default=False)

    looks_ahead = True

    def begin(self, values: Any) -> Draft:
        """A draft that is used up."""
        return _no_draft(values)

    def draw(self, motion: Motion, values: Any, control: Any, *, key: Key[Array, ""]) -> Drawn:
        """Particles moved by the motion, and how."""
        return _drafted(motion, values, control, key)

    def weigh(
        self, particles: Particles, draft: Draft, reading: Reading, resample: Callable[[Particles], Choice]
    ) -> Weighed:
        """Particles chosen by the first-stage weights, drawn again, and weighed by what those missed."""
        particles = _forget(particles, draft, reading)
        conditioned = _conditioned(draft, reading) if self.guided else None
        ahead = reading.log_likelihood(draft.centers) if conditioned is None else conditioned.log_likelihood
        ahead = jnp.where(draft.fresh, ahead, 0.0)
        carried = (particles.values, draft.centers, draft.roots, conditioned, ahead)
        choice = resample(_weighed(Particles(carried, particles.log_weights, particles.valid), ahead))
        values, centers, roots, conditioned, ahead = choice.particles.values
        log_weights = jnp.maximum(choice.particles.log_weights - ahead, NOTHING)
        particles = Particles(values, log_weights, choice.particles.valid)
        draft = Draft(centers, roots, draft.normals, draft.fresh)
        if conditioned is not None:
            return Weighed(_guide(particles, draft, conditioned, reading), _used(draft), choice)
        drawn = jax.vmap(lambda c, r, n: retract(c, matmul(r, n)))(centers, roots, draft.normals)
        particles = _adopt(particles, draft, drawn, reading)
        return Weighed(_weighed(particles, reading.log_likelihood(particles.values)), _used(draft), choice)


def score(log_density: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Zeros with the derivative of a log density: what `f - stop_gradient(f)` is, at no cost where nothing is derived.

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


def _conditioned(draft: Draft, reading: Reading) -> _Conditioned:
    return jax.vmap(lambda center, root: _condition(reading, center, root))(draft.centers, draft.roots)


def _condition(reading: Reading, center: Any, root: Array) -> _Conditioned:
    expected, jacobian = reading.sensor.linearize(center, reading.measurement)
    residual, mask = innovation(expected, reading.measurement, reading.valid)
    covariance = mask_covariance(reading.sensor.covariance(center, reading.measurement), mask)
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


def _guide(particles: Particles, draft: Draft, conditioned: _Conditioned, reading: Reading) -> Particles:
    def move(center, mean, root, normal):
        delta = mean + matmul(root, normal)
        return retract(center, delta), delta

    moved, deltas = jax.vmap(move)(draft.centers, conditioned.mean, conditioned.root, draft.normals)
    particles = _adopt(particles, draft, moved, reading)

    def linear(c, delta):
        return log_normal(c.residual - matmul(c.jacobian, delta), c.covariance, c.mask)

    # What the linear model promised, less what it said of the place drawn: the reading itself says that now.
    promised = conditioned.log_likelihood - jax.vmap(linear)(conditioned, deltas)
    promised = promised if reading.pathwise else lax.stop_gradient(promised)
    found = reading.log_likelihood(particles.values) + jnp.where(draft.fresh, promised, 0.0)
    return _weighed(particles, found)


def _log_density(draft: Draft, values: Any) -> Array:
    """Of the motion that a draft tells of, at values held fixed."""

    def one(center, root, value):
        mask = jnp.ones(root.shape[:1], bool)
        return log_normal(local(center, value), matmul(root, root.T), mask)

    return jax.vmap(one)(draft.centers, draft.roots, lax.stop_gradient(values))


def _forget(particles: Particles, draft: Draft, reading: Reading) -> Particles:
    """Particles without the score of the draws that are about to be replaced."""
    if reading.pathwise:
        return particles
    scores = jnp.where(draft.fresh, score(_log_density(draft, particles.values)), 0.0)
    return Particles(particles.values, particles.log_weights - scores, particles.valid)


def _adopt(particles: Particles, draft: Draft, values: Any, reading: Reading) -> Particles:
    """Particles at new places, with the score of having been drawn there."""
    if reading.pathwise:
        return Particles(_where(draft.fresh, values, particles.values), particles.log_weights, particles.valid)
    values = lax.stop_gradient(values)
    scores = jnp.where(draft.fresh, score(_log_density(draft, values)), 0.0)
    return Particles(_where(draft.fresh, values, particles.values), particles.log_weights + scores, particles.valid)


def _weighed(particles: Particles, log_likelihood: Array) -> Particles:
    log_weights = jnp.maximum(particles.log_weights + log_likelihood, NOTHING)
    return Particles(particles.values, jnp.where(particles.valid, log_weights, NOTHING), particles.valid)


def _drafted(motion: Motion, values: Any, control: Any, key: Array) -> Drawn:
    dimension = tangent_dimension(_first(values))
    normals = _normals(dimension, values, key)

    def move(value, normal):
        center, root = motion.move(value, control), cholesky(motion.covariance(value, control))
        return retract(center, matmul(root, normal)), center, root

    moved, centers, roots = jax.vmap(move)(values, normals)
    draft = Draft(centers, roots, normals, jnp.ones((), bool))
    return Drawn(moved, draft, _log_density(draft, moved))


def _no_draft(values: Any) -> Draft:
    size, dimension = jax.tree.leaves(values)[0].shape[0], tangent_dimension(_first(values))
    zeros = jnp.zeros((size, dimension), dtype_of(values))
    return Draft(values, jnp.zeros((size, dimension, dimension), zeros.dtype), zeros, jnp.zeros((), bool))


def _used(draft: Draft) -> Draft:
    return Draft(draft.centers, draft.roots, draft.normals, jnp.zeros((), bool))


def _normals(dimension: int, values: Any, key: Array) -> Array:
    """Standard normal numbers of all particles in one draw: a key for each would cost more than the numbers."""
    size = jax.tree.leaves(values)[0].shape[0]
    return jax.random.normal(key, (size, dimension), dtype_of(values))


def _first(values: Any) -> Any:
    return jax.tree.map(lambda leaf: leaf[0], values)


def _where(condition: Array, new: Any, old: Any) -> Any:
    return tree.where(condition, new, old)
