"""EKF-SLAM: extended Kalman filter over the pose and all landmarks, with an invariant error.

The error is that of the group of a pose with its points, ``true = exp(xi) estimate``: with it neither the motion nor
the readings depend on the heading, so that the filter cannot gain information about a heading that no reading
observes. With the usual choice of coordinates it does, and becomes overconfident.

References:
    Barrau and Bonnabel, "An EKF-SLAM algorithm with consistency properties", 2015; Zhang et al., "Convergence and
    consistency analysis for a 3D invariant-EKF SLAM", RA-L 2017; Thrun, Burgard, Fox, *Probabilistic Robotics*, 2005,
    chapter 10 [R-15, T-3].
"""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key

from jaxloc import _tree as tree
from jaxloc._jit import filter_jit
from jaxloc._linalg import matmul
from jaxloc.beliefs import Gaussian, Motion, gate, validity
from jaxloc.beliefs.models import innovation, mask_covariance
from jaxloc.beliefs.square_root import cholesky, solve, whiten
from jaxloc.filters import Filter, FilterState, Info
from jaxloc.filters.interface import conclude
from jaxloc.poses import SE2
from jaxloc.poses.lie_group import as_floats
from jaxloc.sensors.landmarks import RangeBearing, locate, locate_covariance, observe, polar_jacobian, sanitize

_QUARTER = ((0.0, -1.0), (1.0, 0.0))  # turns a vector counter-clockwise by a right angle


class SlamState(FilterState):
    """State of EKF-SLAM: pose and map of fixed capacity, with their joint covariance.

    Attributes:
        pose: T_world_robot.
        landmarks: "k 2" in the world, m; zero where never seen.
        covariance: "3+2k" of the invariant error: position, heading, then the landmarks. Use `gaussian` and `landmark`
            for the covariances of the house's tangents.
        seen: which landmarks are in the map.
        support: readings of each landmark that agreed less those that did not.
        step: how many predictions led here.
    """

    pose: SE2
    landmarks: Float[Array, "k 2"]
    covariance: Float[Array, "d d"]
    seen: Bool[Array, " k"]
    support: Int[Array, " k"]
    step: Int[Array, ""]

    def gaussian(self) -> Gaussian:
        """The pose as a density (right perturbation)."""
        forward = self.pose.rotation.matrix().T
        turn = jnp.zeros((3, 3), forward.dtype).at[:2, :2].set(forward).at[2, 2].set(1.0)
        turn = turn.at[:2, 2].set(matmul(forward, _quarter_turn(self.pose.translation)))
        return Gaussian(self.pose, matmul(matmul(turn, self.covariance[:3, :3]), turn.T))

    def landmark(self, index: Int[Array, ""]) -> Gaussian:
        """Density of one landmark in the world; of infinite extent where it was never observed."""
        point, rows = self.landmarks[index], 3 + 2 * index + jnp.arange(2)
        block = self.covariance[jnp.r_[jnp.array([2]), rows]][:, jnp.r_[jnp.array([2]), rows]]
        carry = jnp.concatenate([_quarter_turn(point)[:, None], jnp.eye(2, dtype=point.dtype)], axis=1)
        covariance = matmul(matmul(carry, block), carry.T)
        unknown = jnp.diag(jnp.full(2, jnp.finfo(point.dtype).max ** 0.5, point.dtype))
        return Gaussian(point, jnp.where(self.seen[index], covariance, unknown))


class SlamInfo(Info):
    """Information about an update of `EkfSlam`: a `GaussianInfo`, and whether the reading was used.

    Attributes:
        log_likelihood: of the reading given all earlier ones; zero where it was not used.
        ok: whether the state can be used.
        innovation: (range, bearing) measured minus expected, zero for a new landmark.
        innovation_covariance: its predicted covariance.
        nis: normalized innovation squared, also of a reading that was refused.
        dof: 2, or 0 where the landmark was not in the map.
        accepted: whether it passed the gate.
        landmark: the row of the map that the reading was taken for.
        added: whether it entered the map.
    """

    log_likelihood: Float[Array, ""]
    ok: Bool[Array, ""]
    innovation: Float[Array, "2"]
    innovation_covariance: Float[Array, "2 2"]
    nis: Float[Array, ""]
    dof: Int[Array, ""]
    accepted: Bool[Array, ""]
    landmark: Int[Array, ""]
    added: Bool[Array, ""]


class EkfSlam(Filter):
    """Localization and mapping with range and bearing of landmarks, O(k^2) a step.

    A reading whose landmark is known by number updates that row. With the number -1 it is taken for the row of the map
    that explains it best within the gate, and enters as a new landmark when it lies beyond a second, wider gate of all.
    Landmarks whose readings disagree more often than they agree are measured anew, so that a false first reading
    does no lasting harm.

    Attributes:
        motion: of the robot; its control is the motion's own.
        deviations: standard deviations of range (m) and bearing (rad).
        mount: T_robot_sensor.
        capacity: rows of the map.
        probability: that of the gate.
        probability_new: that of the wider gate beyond which an unnumbered reading is a new landmark.
    """

    motion: Motion
    deviations: Float[Array, "2"]
    mount: SE2
    capacity: int = eqx.field(static=True)
    probability: float = eqx.field(static=True)
    probability_new: float = eqx.field(static=True)

    def __init__(
        self,
        motion: Motion,
        range_deviation: Any,
        bearing_deviation: Any,
        *,
        capacity: int,
        mount: Any = None,
        probability: float = 0.999,
        probability_new: float = 0.999999,
    ):
        self.motion = motion
        self.deviations = jnp.stack(as_floats(range_deviation, bearing_deviation))
        self.mount = SE2.identity(self.deviations.dtype) if mount is None else mount
        self.capacity, self.probability, self.probability_new = capacity, probability, probability_new

    def init(self, prior: Gaussian) -> SlamState:
        """The state before any reading, from a density of the pose; updates are not ``ok`` where it is none."""
        pose, own = validity.usable_or_unknown(prior.mean, prior.covariance)
        size, dtype = 3 + 2 * self.capacity, own.dtype
        turn = jnp.eye(3, dtype=dtype).at[:2, :2].set(pose.rotation.matrix())
        turn = turn.at[:2, 2].set(-_quarter_turn(pose.translation))
        block = matmul(matmul(turn, own), turn.T)
        covariance = jnp.zeros((size, size), dtype).at[:3, :3].set(block)
        none = jnp.zeros(self.capacity, bool)
        landmarks = jnp.zeros((self.capacity, 2), dtype)
        return SlamState(pose, landmarks, covariance, none, none.astype(jnp.int32), jnp.zeros((), jnp.int32))

    @filter_jit
    def predict(self, state: SlamState, control: Any, *, key: Key[Array, ""] | None = None) -> SlamState:
        """Predicts the pose; landmarks stay where they are.

        An increment that is not finite counts as no motion; one that overflows leaves the state unchanged.
        """
        del key
        ok, moved = tree.protect(EkfSlam._moved, self, state, validity.finite_or_neutral(control))
        return _choose(ok, moved, eqx.tree_at(lambda s: s.step, state, state.step + 1))

    def _moved(self, state: SlamState, control: Any) -> tuple[Bool[Array, ""], SlamState]:
        pose = self.motion.move(state.pose, control)
        noise = self.motion.covariance(state.pose, control)
        points = jnp.where(state.seen[:, None], state.landmarks, 0.0)
        moved = jnp.concatenate([pose.rotation.matrix(), -_quarter_turn(pose.translation)[:, None]], axis=1)
        heading = jnp.array([[0.0, 0.0, 1.0]], moved.dtype)
        turned = -matmul(points, jnp.array(_QUARTER, moved.dtype).T).reshape(-1, 1)
        rest = jnp.concatenate([jnp.zeros((turned.shape[0], 2), moved.dtype), turned], axis=1)
        lever = jnp.concatenate([moved, heading, rest])
        covariance = state.covariance + matmul(matmul(lever, noise), lever.T)
        moved = SlamState(pose, state.landmarks, covariance, state.seen, state.support, state.step + 1)
        return _is_usable(moved), moved

    @filter_jit
    def update(
        self, state: SlamState, measurement: RangeBearing, valid: Bool[Array, ""], *, key: Key[Array, ""] | None = None
    ) -> tuple[SlamState, SlamInfo]:
        """Updates pose and landmark by one reading, or adds the landmark to the map."""
        del key
        ok, (after, info) = tree.protect(EkfSlam._updated, self, state, measurement, valid)
        return conclude(ok, after, info, state)

    def _updated(
        self, state: SlamState, measurement: RangeBearing, valid: Bool[Array, ""]
    ) -> tuple[Bool[Array, ""], tuple[SlamState, SlamInfo]]:
        reading, usable = sanitize(measurement, valid & (measurement.landmark < self.capacity))
        index, nis, fresh = self._associate(state, reading)
        near = gate(nis, 2, self.probability) & ~fresh
        distrusted = ~near & ~fresh & (state.support[index] <= 0)
        adds = usable & (fresh | distrusted) & (index < self.capacity)
        added, corrected = self._add(state, reading, index), self._correct(state, reading, index)
        after = _choose(adds, added, _choose(usable & near, corrected[0], state))
        known = usable & ~fresh
        change = jnp.where(adds, 1 - state.support[index], jnp.where(near, 1, -1))
        support = state.support.at[index].add(jnp.where(usable & (known | adds), change, 0), mode="drop")
        after = eqx.tree_at(lambda s: s.support, after, support)
        info = _inform(corrected[1], corrected[2], known, near, index, adds)
        fine = _is_usable(state) & _is_usable(after) & tree.within_range(info.innovation_covariance)
        return fine, (after, eqx.tree_at(lambda i: i.ok, info, fine))

    def _linearize(self, state: SlamState, reading: RangeBearing, index: Any) -> tuple[Array, Array]:
        """Residual of a reading of one row, and its Jacobian by that landmark less the position (world axes)."""
        expected = observe(state.pose @ self.mount, state.landmarks[index], reading.landmark)
        residual, _ = innovation((expected.range, expected.bearing), (reading.range, reading.bearing), jnp.array(True))
        axes = (state.pose @ self.mount).rotation.matrix().T
        return residual, matmul(polar_jacobian(expected), axes)

    def _correct(self, state: SlamState, reading: RangeBearing, index: Any) -> tuple[SlamState, Array, Array]:
        """The state corrected by a reading of a row of the map, its residual and the covariance of that."""
        residual, jacobian = self._linearize(state, reading, index)
        own, other = _blocks(jacobian)
        rows = lax.dynamic_slice_in_dim(state.covariance, 3 + 2 * index, 2, axis=0)
        image = matmul(own, state.covariance[:3]) + matmul(other, rows)
        predicted = self._through(image, own, other, index) + jnp.diag(self.deviations**2)
        gain = solve(cholesky(predicted), image).T
        left = state.covariance - matmul(gain, image)
        back = matmul(left[:, :3], own.T) + matmul(lax.dynamic_slice_in_dim(left, 3 + 2 * index, 2, axis=1), other.T)
        joseph = left - matmul(back, gain.T) + matmul(gain * self.deviations[None] ** 2, gain.T)
        pose, landmarks = _retract(state, matmul(gain, residual))
        moved = SlamState(pose, landmarks, 0.5 * (joseph + joseph.T), state.seen, state.support, state.step)
        return moved, residual, predicted

    def _through(self, image: Array, own: Array, other: Array, index: Any) -> Array:
        columns = lax.dynamic_slice_in_dim(image, 3 + 2 * index, 2, axis=1)
        return matmul(image[:, :3], own.T) + matmul(columns, other.T)

    def _add(self, state: SlamState, reading: RangeBearing, index: Any) -> SlamState:
        """The state with a landmark initialized from a reading, with the covariance of pose and reading."""
        sensor = state.pose @ self.mount
        point = locate(sensor, reading)
        start, zero = 3 + 2 * index, jnp.zeros_like(index)
        own = locate_covariance(sensor, reading, self.deviations)
        cross = state.covariance[:2]
        covariance = lax.dynamic_update_slice(state.covariance, cross, (start, zero))
        covariance = lax.dynamic_update_slice(covariance, cross.T, (zero, start))
        covariance = lax.dynamic_update_slice(covariance, cross[:, :2] + own, (start, start))
        landmarks = lax.dynamic_update_slice(state.landmarks, point[None], (index, zero))
        return SlamState(state.pose, landmarks, covariance, state.seen.at[index].set(True), state.support, state.step)

    def _associate(self, state: SlamState, reading: RangeBearing) -> tuple[Array, Array, Array]:
        """The row a reading belongs to, its squared distance there, and whether it is a landmark not yet in the map."""

        def distance(index):
            residual, jacobian = self._linearize(state, reading, index)
            own, other = _blocks(jacobian)
            rows = lax.dynamic_slice_in_dim(state.covariance, 3 + 2 * index, 2, axis=0)
            columns = lax.dynamic_slice_in_dim(rows, 3 + 2 * index, 2, axis=1)
            mixed = matmul(matmul(own, rows[:, :3].T), other.T)
            predicted = matmul(matmul(own, state.covariance[:3, :3]), own.T) + matmul(matmul(other, columns), other.T)
            root = cholesky(predicted + mixed + mixed.T + jnp.diag(self.deviations**2))
            return jnp.sum(whiten(root, residual) ** 2), jnp.sum(jnp.log(jnp.diagonal(root)))

        squared, volumes = jax.vmap(distance)(jnp.arange(self.capacity))
        numbered = reading.landmark >= 0
        scores = jnp.where(state.seen, squared + 2.0 * volumes, jnp.inf)
        best = jnp.argmin(scores).astype(jnp.int32)
        free = jnp.where(jnp.all(state.seen), self.capacity, jnp.argmin(state.seen)).astype(jnp.int32)
        unlike = ~gate(jnp.min(jnp.where(state.seen, squared, jnp.inf)), 2, self.probability_new)
        index = jnp.where(numbered, reading.landmark.astype(jnp.int32), jnp.where(unlike, free, best))
        within = jnp.minimum(index, self.capacity - 1)
        return index, squared[within], jnp.where(numbered, ~state.seen[within], unlike)


def _inform(residual: Array, predicted: Array, known: Array, near: Array, index: Array, adds: Array) -> SlamInfo:
    """Information about a reading; rejected ones and those of new landmarks do not count in the likelihood."""
    mask = jnp.broadcast_to(known, (2,))
    predicted = mask_covariance(predicted, mask)
    root = cholesky(predicted)
    residual = jnp.where(mask, residual, 0.0)
    nis = jnp.sum(whiten(root, residual) ** 2)
    volume = jnp.sum(jnp.log(jnp.diagonal(root))) + math.log(2.0 * math.pi) * known.astype(nis.dtype)
    accepted, dof = near | ~known, 2 * known.astype(jnp.int32)
    likelihood = jnp.where(near & known, -0.5 * nis - volume, 0.0)
    return SlamInfo(likelihood, accepted, residual, predicted, nis, dof, accepted, index, adds)


def _blocks(jacobian: Float[Array, "2 2"]) -> tuple[Float[Array, "2 3"], Float[Array, "2 2"]]:
    """Jacobians by (position, heading) and by the landmark: in these coordinates no reading shows the heading."""
    return jnp.concatenate([-jacobian, jnp.zeros((2, 1), jacobian.dtype)], axis=1), jacobian


def _quarter_turn(vector: Float[Array, "2"]) -> Float[Array, "2"]:
    return jnp.stack([-vector[1], vector[0]])


def _retract(state: SlamState, error: Float[Array, " d"]) -> tuple[SE2, Float[Array, "k 2"]]:
    """``exp(xi)`` applied to the pose and to all points at once."""
    turn = SE2.exp(jnp.concatenate([error[:2], error[2:3]]))
    # Each point turns with the pose and moves by its own part of the error.
    arc = SE2.exp(jnp.array([1.0, 0.0, 0.0], error.dtype).at[2].set(error[2])).translation
    left = jnp.stack([arc, jnp.stack([-arc[1], arc[0]])], axis=1)
    points = matmul(state.landmarks, turn.rotation.matrix().T) + matmul(error[3:].reshape(-1, 2), left.T)
    return turn @ state.pose, jnp.where(state.seen[:, None], points, state.landmarks)


def _choose(condition: Bool[Array, ""], yes: Any, no: Any) -> Any:
    return tree.where(condition, yes, no)


def _is_usable(state: SlamState) -> Bool[Array, ""]:
    return tree.within_range((state.pose, state.landmarks, state.covariance))
