"""FastSLAM: particles over the path of a robot, and in each a small Kalman filter for every landmark.

Given the path, landmarks are independent of each other (Rao-Blackwell), so that a particle needs a 2x2 covariance for
each instead of one over all: the cost is linear in landmarks, not quadratic, and each particle decides by itself which
landmark a reading belongs to.

References:
    Montemerlo et al., "FastSLAM", AAAI 2002, and "FastSLAM 2.0", IJCAI 2003; Murphy and Russell, "Rao-Blackwellised
    particle filtering", 2001; review section 3.3 [R-15...R-21].
"""

import math
from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy.special import logsumexp
from jaxtyping import Array, Bool, Float, Int, Key

from jaxloc.beliefs import Gaussian, Motion, Particles, gate, resampling
from jaxloc.beliefs.squareroot import cholesky, solve, whiten
from jaxloc.filters.contract import Filter, FilterState, Info
from jaxloc.poses import SE2, retract
from jaxloc.poses.group import as_floats, matmul
from jaxloc.sensors.landmarks import RangeBearing, locate, locate_covariance, observe, polar_jacobian, sanitize

_LIKELY = 0.999  # probability of the gate


class Landmarks(eqx.Module):
    """The map of one particle, of fixed capacity.

    Attributes:
        means: "k 2" in the world, m.
        covariances: "k 2 2" given the particle's path, m^2.
        seen: which there are.
        support: readings of each that agreed less those that did not.
    """

    means: Float[Array, "k 2"]
    covariances: Float[Array, "k 2 2"]
    seen: Bool[Array, " k"]
    support: Int[Array, " k"]


class FastSlamState(FilterState):
    """Particles of paths and maps.

    Attributes:
        poses: T_world_robot, stacked along the particles.
        pending: "n 3 3", covariance of the motion since the pose was last drawn.
        maps: of the particles, stacked.
        log_weights: normalized.
        step: how many predictions led here.
    """

    poses: SE2
    pending: Float[Array, "n 3 3"]
    maps: Landmarks
    log_weights: Float[Array, " n"]
    step: Int[Array, ""]

    def best(self) -> Int[Array, ""]:
        """The particle of largest weight."""
        return jnp.argmax(self.log_weights)

    def gaussian(self) -> Gaussian:
        """The pose as a density: mean and spread of the particles."""
        cloud = Particles(self.poses, self.log_weights)
        spread = cloud.gaussian()
        return Gaussian(spread.mean, spread.covariance + jnp.sum(cloud.weights[:, None, None] * self.pending, axis=0))

    def landmarks(self) -> Float[Array, "k 2"]:
        """The map of the best particle, m."""
        return self.maps.means[self.best()]


class FastSlamInfo(Info):
    """What an update of `FastSlam` says.

    Attributes:
        log_likelihood: of the reading given all earlier ones.
        ok: False when no particle explains the reading; the weights are then kept.
        ess: effective number of particles before resampling.
        resampled: whether new particles were drawn.
        ancestors: which particle each came from: `trace_back` makes paths of them [R-18].
    """

    log_likelihood: Float[Array, ""]
    ok: Bool[Array, ""]
    ess: Float[Array, ""]
    resampled: Bool[Array, ""]
    ancestors: Int[Array, " n"]


class PathProposal(eqx.Module):
    """From which density new poses are drawn."""

    @abstractmethod
    def correctable(self, noise: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
        """The part of the motion's covariance that the reading corrects before a pose is drawn."""


class FromMotion(PathProposal):
    """FastSLAM 1: poses are drawn from the motion alone, and the reading weighs them."""

    def correctable(self, noise: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
        """Nothing."""
        return jnp.zeros_like(noise)


class FromReading(PathProposal):
    """FastSLAM 2: poses are drawn from motion and reading together, so that a sharp sensor wastes no particles."""

    def correctable(self, noise: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
        """All of it."""
        return noise


class FastSlam(Filter):
    """Localization and mapping with range and bearing of landmarks, by Rao-Blackwellized particles.

    A reading with a landmark's number updates that row of each particle's map; with -1 each particle takes it for the
    landmark that explains it best within the gate, or for a new one. A reading outside the gate of a known landmark
    costs the particle the density at the gate and changes nothing else, so that a false identity does not
    destroy a good path; a landmark that is contradicted more often than confirmed is measured anew.

    Attributes:
        motion: of the robot.
        deviations: standard deviations of range (m) and bearing (rad).
        mount: T_robot_sensor.
        proposal: `FromMotion` or `FromReading`.
        num_particles: how many.
        capacity: rows of a map.
        ess_threshold: fraction of the particles below which the effective number triggers resampling.
    """

    motion: Motion
    deviations: Float[Array, "2"]
    mount: SE2
    proposal: PathProposal
    num_particles: int = eqx.field(static=True)
    capacity: int = eqx.field(static=True)
    ess_threshold: float = eqx.field(static=True)

    def __init__(
        self,
        motion: Motion,
        range_deviation: Any,
        bearing_deviation: Any,
        *,
        num_particles: int,
        capacity: int,
        proposal: PathProposal = FromReading(),
        mount: Any = None,
        ess_threshold: float = 0.5,
    ):
        self.motion = motion
        self.deviations = jnp.stack(as_floats(range_deviation, bearing_deviation))
        self.mount = SE2.identity(self.deviations.dtype) if mount is None else mount
        self.proposal, self.num_particles, self.capacity = proposal, num_particles, capacity
        self.ess_threshold = ess_threshold

    def init(self, prior: Gaussian) -> FastSlamState:
        """Particles at the mean of a density of the pose; its spread is drawn with the first reading."""
        n, k, dtype = self.num_particles, self.capacity, prior.covariance.dtype
        poses = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (n, *leaf.shape)), prior.mean)
        nothing = jnp.zeros((n, k), bool)
        maps = jax.vmap(Landmarks)(
            jnp.zeros((n, k, 2), dtype), jnp.zeros((n, k, 2, 2), dtype), nothing, nothing.astype(jnp.int32)
        )
        pending = jnp.broadcast_to(prior.covariance, (n, 3, 3))
        weights = jnp.full(n, -math.log(n), dtype)
        return FastSlamState(poses, pending, maps, weights, jnp.zeros((), jnp.int32))

    @eqx.filter_jit
    def predict(self, state: FastSlamState, control: Any, *, key: Key[Array, ""] | None = None) -> FastSlamState:
        """Every particle moves; its noise stays pending until a reading can say something about it."""
        del key

        def move(pose, pending):
            moved, jacobian = self.motion.linearize(pose, control)
            return moved, matmul(matmul(jacobian, pending), jacobian.T) + self.motion.covariance(pose, control)

        poses, pending = jax.vmap(move)(state.poses, state.pending)
        return FastSlamState(poses, pending, state.maps, state.log_weights, state.step + 1)

    @eqx.filter_jit
    def update(
        self,
        state: FastSlamState,
        measurement: RangeBearing,
        valid: Bool[Array, ""],
        *,
        key: Key[Array, ""] | None = None,
    ) -> tuple[FastSlamState, FastSlamInfo]:
        """One reading: poses are drawn, landmarks corrected or added, weights multiplied, and particles resampled.

        Raises:
            ValueError: without a key.
        """
        if key is None:
            raise ValueError("FastSlam.update draws particles: pass key=jax.random.key(...), as to run(..., key=key).")
        key_draw, key_resample = jax.random.split(key)
        reading, usable = sanitize(measurement, valid & (measurement.landmark < self.capacity))
        normal = jax.random.normal(key_draw, (self.num_particles, 3), state.pending.dtype)
        poses, maps, gains = jax.vmap(self._explain, in_axes=(0, 0, 0, None, 0))(
            state.poses, state.pending, state.maps, reading, normal
        )
        joint = state.log_weights + gains
        total = logsumexp(joint)
        fine = jnp.isfinite(total)
        weights = jnp.where(fine, joint - jnp.where(fine, total, 0.0), state.log_weights)
        ess = Particles(state.poses, weights).ess
        resampled = usable & fine & (ess < self.ess_threshold * self.num_particles)
        own = jnp.arange(self.num_particles, dtype=jnp.int32)
        drawn = resampling.systematic(key_resample, weights, self.num_particles).astype(jnp.int32)
        ancestors = jnp.where(resampled, drawn, own)
        weights = jnp.where(resampled, jnp.full_like(weights, -math.log(self.num_particles)), weights)
        moved = FastSlamState(poses, jnp.zeros_like(state.pending), maps, weights, state.step)
        moved = jax.tree.map(lambda leaf: leaf[ancestors] if leaf.ndim else leaf, moved)
        moved = eqx.tree_at(lambda s: s.log_weights, moved, weights)
        after = jax.tree.map(lambda new, old: jnp.where(usable & fine, new, old), moved, state)
        known = jnp.where(usable & fine, total, 0.0)
        return after, FastSlamInfo(known, fine | ~usable, ess, resampled, ancestors)

    def _explain(self, pose: SE2, pending: Array, known: Landmarks, reading: RangeBearing, normal: Array) -> Any:
        """One particle: a drawn pose, the corrected map, and the log density of the reading."""
        residuals, own, _, spreads = jax.vmap(lambda mean, cov: self._linearize(pose, mean, cov, reading))(
            known.means, known.covariances
        )
        full = spreads + matmul(matmul(own, pending), own.mT)
        index, near, fresh = self._associate(known, residuals, full, reading)
        residual, jacobian = residuals[index], own[index]
        corrects = near & ~fresh
        prior = jnp.where(corrects, self.proposal.correctable(pending), 0.0)
        gain = solve(cholesky(full[index]), matmul(jacobian, prior)).T
        rest = pending - matmul(gain, matmul(jacobian, prior))
        drawn = retract(pose, matmul(gain, residual) + matmul(cholesky(0.5 * (rest + rest.T)), normal))
        # The reading as seen from the drawn pose.
        again, _, other, spread = self._linearize(drawn, known.means[index], known.covariances[index], reading)
        from_reading = jnp.any(prior != 0.0)
        density = _log_density(jnp.where(from_reading, residual, again), jnp.where(from_reading, full[index], spread))
        updated = self._correct(known, index, again, other, spread)
        added = self._add(known, index, drawn, reading)
        distrusted = ~near & ~fresh & (known.support[index] <= 0)
        adds = (fresh | distrusted) & (index < self.capacity)
        change = jnp.where(adds, 1 - known.support[index], jnp.where(near, 1, -1))
        chosen = jax.tree.map(lambda a, b, c: jnp.where(adds, a, jnp.where(corrects, b, c)), added, updated, known)
        support = known.support.at[index].add(change, mode="drop")
        chosen = eqx.tree_at(lambda m: m.support, chosen, support)
        # What is no reading of a known landmark is as likely everywhere, whatever the particle.
        floor = math.log1p(-_LIKELY) - jnp.sum(jnp.log(self.deviations)) - math.log(2.0 * math.pi)
        return drawn, chosen, jnp.where(corrects, jnp.maximum(density, floor), floor)

    def _linearize(self, pose: SE2, mean: Array, covariance: Array, reading: RangeBearing) -> Any:
        """Residual of one landmark, Jacobians by pose and landmark, and the covariance given the pose."""
        sensor = pose @ self.mount
        expected = observe(sensor, mean, reading.landmark)
        residual = jnp.concatenate([(reading.range - expected.range)[None], expected.bearing.local(reading.bearing)])
        polar = polar_jacobian(expected)
        by_landmark = matmul(polar, sensor.rotation.matrix().T)
        # d(landmark in the robot's frame) = -(translation + theta x landmark)
        inside = pose.inverse().apply(mean[None])[0]
        lever = jnp.stack([inside[1], -inside[0]])
        moves = jnp.concatenate([-jnp.eye(2, dtype=mean.dtype), lever[:, None]], axis=1)
        by_pose = matmul(matmul(polar, self.mount.rotation.matrix().T), moves)
        spread = matmul(matmul(by_landmark, covariance), by_landmark.T) + jnp.diag(self.deviations**2)
        return residual, by_pose, by_landmark, spread

    def _associate(self, known: Landmarks, residuals: Array, spreads: Array, reading: RangeBearing) -> Any:
        """The row a reading belongs to, whether it lies within the gate there, and whether it is new."""
        squared = jax.vmap(lambda r, s: jnp.sum(whiten(cholesky(s), r) ** 2))(residuals, spreads)
        numbered = reading.landmark >= 0
        density = jax.vmap(_log_density)(residuals, spreads)
        best = jnp.argmax(jnp.where(known.seen, density, -jnp.inf)).astype(jnp.int32)
        free = jnp.where(jnp.all(known.seen), self.capacity, jnp.argmin(known.seen)).astype(jnp.int32)
        unlike = ~(known.seen[best] & gate(squared[best], 2, _LIKELY))
        index = jnp.where(numbered, reading.landmark.astype(jnp.int32), jnp.where(unlike, free, best))
        within = jnp.minimum(index, self.capacity - 1)
        fresh = jnp.where(numbered, ~known.seen[within], unlike)
        return index, gate(squared[within], 2, _LIKELY), fresh

    def _correct(self, known: Landmarks, index: Array, residual: Array, jacobian: Array, spread: Array) -> Landmarks:
        covariance = known.covariances[index]
        gain = solve(cholesky(spread), matmul(jacobian, covariance)).T
        rest = jnp.eye(2, dtype=gain.dtype) - matmul(gain, jacobian)
        joseph = matmul(matmul(rest, covariance), rest.T) + matmul(gain * self.deviations[None] ** 2, gain.T)
        means = known.means.at[index].add(matmul(gain, residual), mode="drop")
        covariances = known.covariances.at[index].set(joseph, mode="drop")
        return Landmarks(means, covariances, known.seen, known.support)

    def _add(self, known: Landmarks, index: Array, pose: SE2, reading: RangeBearing) -> Landmarks:
        sensor = pose @ self.mount
        covariance = locate_covariance(sensor, reading, self.deviations)
        means = known.means.at[index].set(locate(sensor, reading), mode="drop")
        covariances = known.covariances.at[index].set(covariance, mode="drop")
        return Landmarks(means, covariances, known.seen.at[index].set(True, mode="drop"), known.support)


@eqx.filter_jit
def trace_back(poses: SE2, ancestors: Int[Array, "t n"], particle: Int[Array, ""]) -> SE2:
    """The path of one of the last particles, from the poses and ancestors of each update [R-18].

    Args:
        poses: of all particles after each update, stacked along steps and particles.
        ancestors: `FastSlamInfo.ancestors` of each update.
        particle: index among the last particles.

    Returns:
        Poses stacked along the steps.

    Example:
        >>> import jax, jax.numpy as jnp, jaxloc as jl
        >>> x = jnp.array([[0.0, 1.0], [10.0, 11.0]])
        >>> poses = jax.vmap(jax.vmap(lambda x: jl.poses.SE2(x, 0.0, 0.0)))(x)
        >>> ancestors = jnp.array([[0, 1], [1, 1]])
        >>> jl.filters.rao_blackwell.trace_back(poses, ancestors, jnp.array(0)).translation[:, 0].tolist()
        [1.0, 10.0]
    """

    def back(current, inputs):
        here, parents = inputs
        return parents[current], jax.tree.map(lambda leaf: leaf[current], here)

    return lax.scan(back, particle.astype(ancestors.dtype), (poses, ancestors), reverse=True)[1]


def _log_density(residual: Float[Array, "2"], spread: Float[Array, "2 2"]) -> Float[Array, ""]:
    root = cholesky(spread)
    volume = jnp.sum(jnp.log(jnp.diagonal(root)))
    return -0.5 * jnp.sum(whiten(root, residual) ** 2) - volume - math.log(2.0 * math.pi)
