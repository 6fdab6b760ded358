"""Landmark recordings: odometry and one sensor, merged into filter steps."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float64, Int64

from jaxloc.poses import SE2, SO2
from jaxloc.poses.planar import relative_poses
from jaxloc.sensors import Increment, Range, RangeBearing


class LandmarkLog(eqx.Module):
    """Landmark recording as filter steps, each with a control and at most one reading.

    Attributes:
        start: stamp of time zero, s (a host number in double precision).
        times: of the steps, s since the start.
        increments: motion since the step before, stacked.
        readings: `RangeBearing` or `Range` records, stacked; ``landmark`` is a row of ``landmarks``.
        valid: which steps have a reading.
        landmarks: true positions in the world, "k 2" m; nan where unknown.
        names: the number each landmark has in the recording.
        truth: T_world_robot at the steps, stacked.
        truth_valid: where it is known.
    """

    start: float = eqx.field(static=True)
    times: Float[Array, " t"]
    increments: Increment
    readings: Any
    valid: Bool[Array, " t"]
    landmarks: Float[Array, "k 2"]
    names: tuple[int, ...] = eqx.field(static=True)
    truth: SE2
    truth_valid: Bool[Array, " t"]

    def __len__(self) -> int:
        """Number of steps."""
        return self.times.shape[-1]

    def first(self, count: int) -> "LandmarkLog":
        """The first steps."""
        parts = (self.times, self.increments, self.readings, self.valid, self.truth, self.truth_valid)
        times, increments, readings, valid, truth, truth_valid = jax.tree.map(lambda leaf: leaf[:count], parts)
        fixed = (self.landmarks, self.names)
        return LandmarkLog(self.start, times, increments, readings, valid, *fixed, truth, truth_valid)

    def renumbered(self, numbers: Int64[np.ndarray, " k"]) -> "LandmarkLog":
        """The log with renumbered landmarks: ``numbers[i]`` in place of i."""
        rows = jnp.asarray(numbers, self.readings.landmark.dtype)[self.readings.landmark]
        return eqx.tree_at(lambda log: log.readings.landmark, self, rows)


def assemble(
    start: float,
    times: Float64[np.ndarray, " t"],
    odometry: Float64[np.ndarray, "t 3"],
    readings: Any,
    landmarks: tuple[tuple[int, ...], Float64[np.ndarray, "k 2"]],
    truth: tuple[Float64[np.ndarray, "t 3"], Bool[np.ndarray, " t"]],
) -> LandmarkLog:
    """A log from host arrays.

    Args:
        start: stamp of time zero, s.
        times: of the steps, s since the start.
        odometry: dead-reckoned pose (x, y, theta) at each step.
        readings: stacked `Range` or `RangeBearing` (see `ranges`, `ranges_and_bearings`).
        landmarks: their names and true positions.
        truth: true poses at the steps, and where they are known.

    Returns:
        The log; arrays are of the default floating type.
    """
    motions = relative_poses(np.vstack([odometry[:1], odometry[:-1]]), odometry)
    increments = jax.vmap(Increment)(jnp.asarray(np.diff(times, prepend=times[:1]), float), _stack(motions))
    poses, known = truth
    return LandmarkLog(
        start=start,
        times=jnp.asarray(times, float),
        increments=increments,
        readings=readings,
        valid=jnp.ones(len(times), bool),
        landmarks=jnp.asarray(landmarks[1], float),
        names=landmarks[0],
        truth=_stack(np.where(known[:, None], poses, 0.0)),
        truth_valid=jnp.asarray(known),
    )


def ranges(values: Float64[np.ndarray, " t"], rows: Int64[np.ndarray, " t"]) -> Range:
    """Stacked range readings of host arrays."""
    return jax.vmap(Range)(jnp.asarray(values, float), jnp.asarray(rows, jnp.int32))


def ranges_and_bearings(
    values: Float64[np.ndarray, " t"], bearings: Float64[np.ndarray, " t"], rows: Int64[np.ndarray, " t"]
) -> RangeBearing:
    """Stacked range-bearing readings of host arrays."""
    direction = jax.vmap(SO2)(jnp.asarray(np.cos(bearings), float), jnp.asarray(np.sin(bearings), float))
    return jax.vmap(RangeBearing)(jnp.asarray(values, float), direction, jnp.asarray(rows, jnp.int32))


def _stack(poses: np.ndarray) -> SE2:
    cos, sin = jnp.asarray(np.cos(poses[:, 2]), float), jnp.asarray(np.sin(poses[:, 2]), float)
    return jax.vmap(SE2.from_parts)(jax.vmap(SO2)(cos, sin), jnp.asarray(poses[:, :2], float))
