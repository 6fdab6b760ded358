"""Range and bearing measurements of point landmarks in the plane."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxloc import _tree as tree
from jaxloc._arguments import checked
from jaxloc._jit import filter_jit
from jaxloc._linalg import matmul
from jaxloc.beliefs import Sensor
from jaxloc.poses import SE2, SO2
from jaxloc.poses.lie_group import as_floats

_NEAREST = 1e-3  # least range with a bearing, m


class RangeBearing(eqx.Module):
    """A range and bearing measurement of one landmark.

    Attributes:
        range: m.
        bearing: direction in the frame of the sensor, counter-clockwise from its x axis.
        landmark: index of the landmark: a row of the map.
    """

    range: Float[Array, ""]
    bearing: SO2
    landmark: Int[Array, ""]


class DescribedReading(eqx.Module):
    """A range and bearing measurement with a descriptor, such as that of a SIFT feature.

    Attributes:
        reading: range and bearing; ``landmark`` is -1 where the landmark is identified by its descriptor.
        descriptor: "d", similar for measurements of the same landmark.
    """

    reading: RangeBearing
    descriptor: Float[Array, " d"]


class RangeBearingSensor(Sensor):
    """Ranges and bearings of known landmarks from a planar pose; noise is independent in both.

    Attributes:
        landmarks: "k 2" in the world, m.
        deviations: standard deviations of range (m) and bearing (rad).
        mount: T_robot_sensor.

    References:
        Thrun, Burgard, Fox, *Probabilistic Robotics*, 2005, section 6.6.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> sensor = jl.sensors.RangeBearingSensor(jnp.array([[3.0, 4.0]]), 0.1, 0.02)
        >>> reading = jl.sensors.RangeBearing(jnp.array(5.0), jl.poses.SO2.identity(), jnp.array(0))
        >>> float(sensor.expect(jl.poses.SE2(0.0, 0.0, 0.0), reading).range)
        5.0
    """

    landmarks: Float[Array, "k 2"]
    deviations: Float[Array, "2"]
    mount: SE2

    def __init__(self, landmarks: Float[Array, "k 2"], range_deviation: Any, bearing_deviation: Any, mount: Any = None):
        dtype = landmarks.dtype
        self.landmarks = landmarks
        self.deviations = jnp.stack([x.astype(dtype) for x in as_floats(range_deviation, bearing_deviation)])
        self.mount = SE2.identity(dtype) if mount is None else mount

    def expect(self, state: Any, measurement: RangeBearing) -> RangeBearing:
        """Range and bearing of the landmark from a pose, or from a record with a pose."""
        sensor = pose_of(state) @ self.mount
        return observe(sensor, row(self.landmarks, measurement.landmark), measurement.landmark)

    def covariance(self, state: Any, measurement: RangeBearing) -> Float[Array, "2 2"]:
        """Covariance of (range, bearing)."""
        del state, measurement
        return jnp.diag(self.deviations**2)


@checked
def observe(sensor: SE2, landmark: Float[Array, "2"], index: Int[Array, ""]) -> RangeBearing:
    """Range and bearing of a landmark from T_world_sensor; finite and differentiable even at the landmark.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> reading = jl.sensors.landmarks.observe(jl.poses.SE2(0.0, 0.0, 0.0), jnp.array([0.0, 2.0]), jnp.array(7))
        >>> float(reading.range), round(float(reading.bearing.angle()), 4)
        (2.0, 1.5708)
    """
    local = sensor.inverse().apply(landmark[None])[0]
    distance = length(local)
    here = distance <= float(jnp.finfo(distance.dtype).tiny) ** 0.5
    direction = jnp.where(here, jnp.array([1.0, 0.0], local.dtype), local) / jnp.where(here, 1.0, distance)
    return RangeBearing(distance, SO2(direction[0], direction[1]), index)


@checked
def locate(sensor: SE2, reading: RangeBearing) -> Float[Array, "2"]:
    """Position in the world of a landmark measured from T_world_sensor: the inverse of `observe`.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> reading = jl.sensors.RangeBearing(jnp.array(2.0), jl.poses.SO2.from_angle(0.0), jnp.array(0))
        >>> jl.sensors.landmarks.locate(jl.poses.SE2(1.0, 0.0, 0.0), reading).tolist()
        [3.0, 0.0]
    """
    local = reading.range * jnp.stack([reading.bearing.cos, reading.bearing.sin])
    return sensor.apply(local[None])[0]


@checked
def locate_covariance(sensor: SE2, reading: RangeBearing, deviations: Float[Array, "2"]) -> Float[Array, "2 2"]:
    """Covariance of `locate` by the noise of range and bearing, in the world.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> reading = jl.sensors.RangeBearing(jnp.array(2.0), jl.poses.SO2.identity(), jnp.array(0))
        >>> pose, deviations = jl.poses.SE2(1.0, 0.0, 0.0), jnp.array([0.5, 0.25])
        >>> jl.sensors.landmarks.locate_covariance(pose, reading, deviations).tolist()
        [[0.25, 0.0], [0.0, 0.25]]
    """
    ray = jnp.stack([reading.bearing.cos, reading.bearing.sin])
    axes = matmul(sensor.rotation.matrix(), jnp.stack([ray, jnp.stack([-ray[1], ray[0]])], axis=1))
    scaled = jnp.stack([deviations[0], deviations[1] * reading.range])
    return matmul(axes * scaled[None] ** 2, axes.T)


@checked
def polar_jacobian(reading: RangeBearing) -> Float[Array, "2 2"]:
    """Derivative of (range, bearing) by the landmark's position in the frame of the sensor.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> reading = jl.sensors.RangeBearing(jnp.array(2.0), jl.poses.SO2.identity(), jnp.array(0))
        >>> jl.sensors.landmarks.polar_jacobian(reading).tolist()
        [[1.0, 0.0], [-0.0, 0.5]]
    """
    ray = jnp.stack([reading.bearing.cos, reading.bearing.sin])
    across = jnp.stack([-ray[1], ray[0]]) / jnp.maximum(reading.range, _NEAREST)
    return jnp.stack([ray, across])


@filter_jit
@checked
def confusion(
    sensor: RangeBearingSensor, poses: SE2, readings: RangeBearing, valid: Bool[Array, " t"], *, limit: float = 20.0
) -> Float[Array, "k k"]:
    """Misfit of the measurements of each label to each landmark, to correct mislabeled recordings.

    The best one-to-one assignment of its rows to its columns, as by SciPy's `linear_sum_assignment`, maps labels to
    landmarks.

    Args:
        sensor: with the landmarks.
        poses: T_world_robot, stacked, from a gated filter.
        readings: stacked.
        valid: mask of the readings.
        limit: largest squared distance that one reading adds.

    Returns:
        Mean of ``min(d^2, limit)`` of the readings with label i, relative to landmark j; `limit` for labels never read.

    Example:
        >>> import jax, jax.numpy as jnp, jaxloc as jl
        >>> sensor = jl.sensors.RangeBearingSensor(jnp.array([[1.0, 0.0], [3.0, 0.0]]), 0.1, 0.1)
        >>> robot = jax.vmap(lambda x: jl.poses.SE2(x, 0.0, 0.0))(jnp.zeros(2))
        >>> labels = jax.vmap(jl.sensors.RangeBearing)(jnp.ones(2), robot.rotation, jnp.arange(2))
        >>> readings = jax.vmap(sensor.expect)(robot, labels)
        >>> jl.sensors.landmarks.confusion(sensor, robot, readings, jnp.ones(2, bool)).tolist()
        [[0.0, 20.0], [20.0, 0.0]]
    """
    count = sensor.landmarks.shape[0]

    def distance(pose, reading, number):
        expected = sensor.expect(pose, RangeBearing(reading.range, reading.bearing, number))
        gap = jnp.concatenate([(reading.range - expected.range)[None], expected.bearing.local(reading.bearing)])
        return jnp.minimum(jnp.sum((gap / sensor.deviations) ** 2), limit)

    def against_all(pose, reading):
        return jax.vmap(lambda number: distance(pose, reading, number))(jnp.arange(count, dtype=jnp.int32))

    safe, usable = jax.vmap(sanitize)(readings, valid)
    squared = jax.vmap(against_all)(poses, safe)
    labeled = (safe.landmark[:, None] == jnp.arange(count, dtype=safe.landmark.dtype)[None, :]) & usable[:, None]
    weights = labeled.astype(squared.dtype)
    total = jnp.sum(weights, axis=0)
    mean = matmul(weights.T, squared) / jnp.maximum(total, 1.0)[:, None]
    return jnp.where((total > 0)[:, None], mean, limit)


@checked
def sanitize(reading: RangeBearing, valid: Bool[Array, ""]) -> tuple[RangeBearing, Bool[Array, ""]]:
    """A reading with non-finite values replaced, and whether it was valid, finite and within range."""
    values = jnp.stack([reading.range, reading.bearing.cos, reading.bearing.sin])
    unit = jnp.abs(reading.bearing.cos**2 + reading.bearing.sin**2 - 1.0) < 0.1
    usable = valid & tree.within_range(values) & (reading.range > 0.0) & unit
    stand_in = jnp.ones_like(reading.range), SO2.identity(reading.range.dtype)
    safe = tree.where(usable, (reading.range, reading.bearing), stand_in)
    return RangeBearing(*safe, reading.landmark), usable


def pose_of(state: Any) -> SE2:
    """The pose of a state that is a pose, or has a field ``pose``."""
    return state if isinstance(state, SE2) else state.pose


@checked
def row(table: Float[Array, "k 2"], index: Int[Array, ""]) -> Float[Array, "2"]:
    """A row of a map; indices out of range are clipped."""
    return jnp.take(table, index, axis=0, mode="clip")


@checked
def length(offset: Float[Array, "2"]) -> Float[Array, ""]:
    """Length of a vector with a finite derivative at zero."""
    squared = jnp.sum(offset**2)
    zero = squared <= float(jnp.finfo(offset.dtype).tiny)
    return jnp.where(zero, 0.0, jnp.sqrt(jnp.where(zero, 1.0, squared)))
