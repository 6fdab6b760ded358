"""FastSLAM filter: predict, update and resampling."""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy.special import logsumexp
from jaxtyping import Array, Bool, Float, Int, Key

from jaxloc import _tree as tree
from jaxloc._jit import filter_jit
from jaxloc._linalg import matmul
from jaxloc.beliefs import Gaussian, Motion, Particles, resampling, validity
from jaxloc.filters.interface import Filter, Info, conclude
from jaxloc.poses import SE2
from jaxloc.poses.lie_group import as_floats
from jaxloc.sensors.landmarks import RangeBearing, sanitize
from jaxloc.slam.fast_slam.association import Candidates
from jaxloc.slam.fast_slam.landmark_filter import LandmarkFilter, Landmarks
from jaxloc.slam.fast_slam.proposals import MeasurementProposal, Observation, Particle, PathProposal
from jaxloc.slam.fast_slam.state import FastSlamState


class FastSlamInfo(Info):
    """Information about an update of `FastSlam`.

    Attributes:
        log_likelihood: of the reading given all earlier ones.
        ok: False when no particle explains the reading; the weights are then kept.
        ess: effective number of particles before resampling.
        resampled: whether new particles were drawn.
        ancestors: which particle each came from: `trace_back` makes paths of them [R-18].
        landmark: the row of its map that each particle changed, before resampling; -1 where it refused the reading or
            had no room.
    """

    log_likelihood: Float[Array, ""]
    ok: Bool[Array, ""]
    ess: Float[Array, ""]
    resampled: Bool[Array, ""]
    ancestors: Int[Array, " n"]
    landmark: Int[Array, " n"]


class FastSlam(Filter):
    """FastSLAM with range-bearing landmarks, versions 1 and 2 by choice of the proposal.

    A reading with a landmark's number updates that row of each particle's map; with -1 each particle takes it for the
    landmark that explains it best within the gate, or for a new one. A reading outside the gate of a known landmark
    costs the particle the density at the gate and changes nothing else, so that a false identity does not
    destroy a good path; a landmark that is contradicted more often than confirmed is measured anew.

    Attributes:
        motion: of the robot.
        deviations: standard deviations of range (m) and bearing (rad).
        mount: T_robot_sensor.
        proposal: `MotionProposal`, `MeasurementProposal` or `BlockProposal`.
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
        proposal: PathProposal = MeasurementProposal(),
        mount: Any = None,
        ess_threshold: float = 0.5,
    ):
        self.motion = motion
        self.deviations = jnp.stack(as_floats(range_deviation, bearing_deviation))
        self.mount = SE2.identity(self.deviations.dtype) if mount is None else mount
        self.proposal, self.num_particles, self.capacity = proposal, num_particles, capacity
        self.ess_threshold = ess_threshold

    @property
    def landmark_filter(self) -> LandmarkFilter:
        """The Kalman filter of each landmark."""
        return LandmarkFilter(self.deviations, self.mount)

    def init(self, prior: Gaussian) -> FastSlamState:
        """Initial state: particles at the mean of the prior; its covariance is sampled at the first reading.

        Updates are not ``ok`` where the prior is no density.
        """
        mean, covariance = validity.usable_or_unknown(prior.mean, prior.covariance)
        n, dtype, size = self.num_particles, covariance.dtype, self.proposal.num_pending(self.capacity)
        pending = jnp.zeros((size, size), dtype).at[:3, :3].set(covariance)
        one = (mean, pending, Landmarks.empty(self.capacity, dtype))
        poses, pending, maps = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (n, *leaf.shape)), one)
        weights = jnp.full(n, -math.log(n), dtype)
        return FastSlamState(poses, pending, maps, weights, jnp.zeros((), jnp.int32))

    @filter_jit
    def predict(self, state: FastSlamState, control: Any, *, key: Key[Array, ""] | None = None) -> FastSlamState:
        """Predicts all particles; the motion noise stays pending until the next reading.

        An increment that is not finite counts as no motion; one that overflows leaves the particles unchanged.

        Raises:
            ValueError: without a key, where the proposal draws between readings.
        """
        if key is None and self.proposal.draws_now(state.step) is not None:
            raise ValueError("FastSlam.predict draws poses: pass key=jax.random.key(...), as to run(..., key=key).")
        ok, moved = tree.protect(FastSlam._moved, self, state, validity.finite_or_neutral(control), key)
        return tree.where(ok, moved, eqx.tree_at(lambda s: s.step, state, state.step + 1))

    def _moved(self, state: FastSlamState, control: Any, key: Array | None) -> tuple[Bool[Array, ""], FastSlamState]:
        particles = jax.vmap(Particle)(state.poses, state.pending, state.maps)
        due = self.proposal.draws_now(state.step)
        if due is not None:
            normal = jax.random.normal(key, state.pending.shape[:2], state.pending.dtype)
            particles = lax.cond(due, lambda: jax.vmap(self.proposal.draw)(particles, normal), lambda: particles)

        def move(pose, pending):
            moved, jacobian = self.motion.linearize(pose, control)
            pending = pending.at[:3].set(matmul(jacobian, pending[:3]))
            pending = pending.at[:, :3].set(matmul(pending[:, :3], jacobian.T))
            return moved, pending.at[:3, :3].add(self.motion.covariance(pose, control))

        poses, pending = jax.vmap(move)(particles.pose, particles.pending)
        moved = FastSlamState(poses, pending, particles.known, state.log_weights, state.step + 1)
        return _is_usable(moved), moved

    @filter_jit
    def update(
        self,
        state: FastSlamState,
        measurement: RangeBearing,
        valid: Bool[Array, ""],
        *,
        key: Key[Array, ""] | None = None,
    ) -> tuple[FastSlamState, FastSlamInfo]:
        """Updates by one reading: draws poses, corrects or adds landmarks, weighs and resamples particles.

        Raises:
            ValueError: without a key.
        """
        candidates = Candidates.anything(self.capacity, state.pending.dtype)
        return self.update_among(state, measurement, valid, candidates, key=key)

    def update_among(
        self,
        state: FastSlamState,
        measurement: RangeBearing,
        valid: Bool[Array, ""],
        candidates: Candidates,
        *,
        key: Key[Array, ""] | None = None,
    ) -> tuple[FastSlamState, FastSlamInfo]:
        """`update` by a reading with given candidate landmarks.

        Raises:
            ValueError: without a key.
        """
        if key is None:
            raise ValueError("FastSlam.update draws particles: pass key=jax.random.key(...), as to run(..., key=key).")
        ok, (after, info) = tree.protect(FastSlam._updated, self, state, measurement, valid, candidates, key)
        return conclude(ok, after, info, state)

    def _updated(
        self,
        state: FastSlamState,
        measurement: RangeBearing,
        valid: Bool[Array, ""],
        candidates: Candidates,
        key: Array,
    ) -> tuple[Bool[Array, ""], tuple[FastSlamState, FastSlamInfo]]:
        key_draw, key_resample = jax.random.split(key)
        reading, usable = sanitize(measurement, valid & (measurement.landmark < self.capacity))
        normal = jax.random.normal(key_draw, state.pending.shape[:2], state.pending.dtype)
        before, observation = (
            jax.vmap(Particle)(state.poses, state.pending, state.maps),
            Observation(reading, candidates),
        )
        update_particle = jax.vmap(self.proposal.update_particle, in_axes=(None, 0, None, 0))
        found = update_particle(self.landmark_filter, before, observation, normal)
        joint = state.log_weights + found.log_density
        total = logsumexp(joint)
        fine = usable & jnp.isfinite(total) & tree.all_finite(found.particle)
        weights = jnp.where(fine, joint - jnp.where(fine, total, 0.0), state.log_weights)
        ess = Particles(state.poses, weights).ess
        resampled = fine & (ess < self.ess_threshold * self.num_particles)
        own = jnp.arange(self.num_particles, dtype=jnp.int32)
        drawn = resampling.systematic(key_resample, weights, self.num_particles).astype(jnp.int32)
        ancestors = jnp.where(resampled, drawn, own)
        weights = jnp.where(resampled, jnp.full_like(weights, -math.log(self.num_particles)), weights)
        after = jax.tree.map(lambda new, old: jnp.where(fine, new[ancestors], old), found.particle, before)
        info = FastSlamInfo(
            log_likelihood=jnp.where(fine, total, 0.0),
            ok=fine | ~usable,
            ess=ess,
            resampled=resampled,
            ancestors=ancestors,
            landmark=jnp.where(fine, found.row, -1),
        )
        after = FastSlamState(after.pose, after.pending, after.known, weights, state.step)
        deviations = tree.within_range((self.deviations**2, 1.0 / self.deviations))
        return info.ok & _is_usable(state) & deviations, (after, info)


def _is_usable(state: FastSlamState) -> Bool[Array, ""]:
    return tree.within_range((state.poses, state.pending, state.maps))


@filter_jit
def trace_back(poses: SE2, ancestors: Int[Array, "t n"], particle: Int[Array, ""]) -> SE2:
    """Path of one of the final particles, from the poses and ancestors of each update [R-18].

    Args:
        poses: of all particles after each update, stacked along steps and particles. With `BlockProposal` they are
            means, for the path within a block is not drawn.
        ancestors: `FastSlamInfo.ancestors` of each update.
        particle: index among the last particles.

    Returns:
        Poses stacked along the steps.

    Example:
        >>> import jax, jax.numpy as jnp, jaxloc as jl
        >>> x = jnp.array([[0.0, 1.0], [10.0, 11.0]])
        >>> poses = jax.vmap(jax.vmap(lambda x: jl.poses.SE2(x, 0.0, 0.0)))(x)
        >>> ancestors = jnp.array([[0, 1], [1, 1]])
        >>> jl.slam.fast_slam.trace_back(poses, ancestors, jnp.array(0)).translation[:, 0].tolist()
        [1.0, 10.0]
    """

    def back(current, inputs):
        here, parents = inputs
        return parents[current], jax.tree.map(lambda leaf: leaf[current], here)

    return lax.scan(back, particle.astype(ancestors.dtype), (poses, ancestors), reverse=True)[1]
