"""Range measurements to radio beacons, with an estimated bias and scale error."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxloc.beliefs import Motion, Sensor
from jaxloc.poses import SE2
from jaxloc.poses.lie_group import as_floats
from jaxloc.sensors.increments import Increment, IncrementMotion
from jaxloc.sensors.landmarks import length, pose_of, row


class Range(eqx.Module):
    """A range measurement to a known beacon.

    Attributes:
        range: m.
        landmark: index of the beacon: a row of the map.
    """

    range: Float[Array, ""]
    landmark: Int[Array, ""]


class RangingState(eqx.Module):
    """State of a robot whose ranging measures ``(1 + scale) distance + bias``, with bias and scale estimated.

    Attributes:
        pose: T_world_robot.
        bias: of ranges, m.
        scale: relative scale error of ranges.
    """

    pose: SE2
    bias: Float[Array, ""]
    scale: Float[Array, ""]


class RangeSensor(Sensor):
    """Ranges to known beacons, with the bias and the scale of a `RangingState`, or without for a plain pose.

    Attributes:
        landmarks: "k 2" in the world, m.
        deviation: standard deviation, m.

    References:
        Djugash and Singh, "Motion-aided network SLAM with range", IJRR 2012.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> sensor = jl.sensors.RangeSensor(jnp.array([[3.0, 4.0]]), 0.5)
        >>> reading = jl.sensors.Range(jnp.array(5.0), jnp.array(0))
        >>> biased = jl.sensors.RangingState(jl.poses.SE2(0.0, 0.0, 0.0), jnp.array(0.5), jnp.array(0.1))
        >>> float(sensor.expect(biased, reading).range)
        6.0
    """

    landmarks: Float[Array, "k 2"]
    deviation: Float[Array, ""]

    def __init__(self, landmarks: Float[Array, "k 2"], deviation: Any):
        self.landmarks = landmarks
        self.deviation = as_floats(deviation)[0].astype(landmarks.dtype)

    def expect(self, state: Any, measurement: Range) -> Range:
        """The range from a pose."""
        offset = row(self.landmarks, measurement.landmark) - pose_of(state).translation
        distance = length(offset)
        if isinstance(state, RangingState):
            distance = (1.0 + state.scale) * distance + state.bias
        return Range(distance, measurement.landmark)

    def covariance(self, state: Any, measurement: Range) -> Float[Array, "1 1"]:
        """Variance of the range."""
        del state, measurement
        return (self.deviation**2)[None, None]


class RangingMotion(Motion):
    """Motion of a `RangingState`: the pose follows odometry, bias and scale are random walks.

    Attributes:
        motion: of the pose.
        walks: standard deviations of the random walks of bias (m) and scale after 1 s.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> motion = jl.sensors.RangingMotion(jl.sensors.IncrementMotion(), 0.01, 0.001)
        >>> state = jl.sensors.RangingState(jl.poses.SE2(0.0, 0.0, 0.0), jnp.array(0.5), jnp.array(0.0))
        >>> control = jl.sensors.Increment(jnp.array(1.0), jl.poses.SE2(1.0, 0.0, 0.0))
        >>> motion.covariance(state, control).shape
        (5, 5)
    """

    motion: IncrementMotion
    walks: Float[Array, "2"]

    def __init__(self, motion: IncrementMotion, bias_walk: Any, scale_walk: Any):
        self.motion = motion
        self.walks = jnp.stack(as_floats(bias_walk, scale_walk))

    def move(self, state: RangingState, control: Increment) -> RangingState:
        """The state after an increment."""
        return RangingState(self.motion.move(state.pose, control), state.bias, state.scale)

    def covariance(self, state: RangingState, control: Increment) -> Float[Array, "5 5"]:
        """Covariance of (pose, bias, scale)."""
        covariance = jnp.zeros((5, 5), self.walks.dtype).at[:3, :3].set(self.motion.covariance(state.pose, control))
        return covariance.at[3:, 3:].set(jnp.diag(self.walks**2 * control.dt))
