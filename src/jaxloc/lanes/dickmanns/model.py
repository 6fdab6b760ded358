"""Clothoid lane model for a Kalman filter: state, motion model and border measurement model."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxloc.beliefs import Motion, Sensor
from jaxloc.lanes.lane import Lane
from jaxloc.poses.lie_group import as_floats
from jaxloc.sensors.ground_camera import GroundCamera

_STEPS = 3  # of Newton's iteration for the range that a row shows, before the one that is differentiated


class RoadState(eqx.Module):
    """State of the lane filter; its tangent has the order offset, heading, curvature, curvature rate, width, pitch.

    Args:
        lane: beside the vehicle.
        width: of the lane, from the middle of one border to that of the other, m.
        pitch: pitch of the camera relative to its mean, positive down, rad.
    """

    lane: Lane
    width: Float[Array, ""]
    pitch: Float[Array, ""]

    def __init__(self, lane: Lane, width: Any = 3.6, pitch: Any = 0.0):
        self.lane = lane
        self.width, self.pitch = (jnp.asarray(part, lane.offset.dtype) for part in (width, pitch))

    def border(self, x: Float[Array, "*n"], side: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Lateral position of the borders at ranges x, m: side 1 for the left one, -1 for the right one."""
        return self.lane.center(x) + 0.5 * self.width * side

    def camera(self, ground: GroundCamera) -> GroundCamera:
        """The camera with its pitch."""
        return eqx.tree_at(lambda g: g.pitch, ground, ground.pitch + self.pitch.astype(ground.pitch.dtype))


class Ride(eqx.Module):
    """Control input of one filter step.

    Args:
        dt: s since the last image.
        speed: of the vehicle, m/s.
        yaw_rate: counter-clockwise, rad/s.
        yaw_known: False to take the vehicle to follow the lane.
    """

    dt: Float[Array, ""]
    speed: Float[Array, ""]
    yaw_rate: Float[Array, ""]
    yaw_known: Bool[Array, ""]

    def __init__(self, dt: Any, speed: Any, yaw_rate: Any = 0.0, yaw_known: Any = True):
        self.dt, self.speed, self.yaw_rate = as_floats(dt, speed, yaw_rate)
        self.yaw_known = jnp.asarray(yaw_known)


class LaneMotion(Motion):
    """Motion model: the vehicle advances along the lane, curvature is a random walk, pitch returns to its mean.

    All sigmas are of random walks, by the root of the time or way over which they act.

    Args:
        offset: m by root s,
        heading: rad by root s,
        bend: of the rate of curvature, 1/m^2 by root m,
        straighten: way over which that rate is forgotten, m,
        width: m by root m,
        pitch: standard deviation of the pitch, rad,
        pitch_time: over which it is forgotten, s.

    References:
        E. D. Dickmanns and B. D. Mysliwetz, "Recursive 3-D road and relative ego-state recognition", PAMI 1992 [K-31].

    Example:
        >>> import jaxloc as jl
        >>> state = jl.lanes.dickmanns.RoadState(jl.lanes.Lane(0.0, 0.02, 0.0))
        >>> moved = jl.lanes.dickmanns.LaneMotion().move(state, jl.lanes.dickmanns.Ride(0.5, 20.0))
        >>> round(float(moved.lane.offset), 3)
        0.2
    """

    offset: float = 0.15
    heading: float = 0.03
    bend: float = 2e-6
    straighten: float = 150.0
    width: float = 0.01
    pitch: float = 0.006
    pitch_time: float = 0.3

    def move(self, state: RoadState, control: Ride) -> RoadState:
        """The state after a step without noise."""
        lane, distance = state.lane, control.speed * control.dt
        bend = distance * (lane.curvature + 0.5 * distance * lane.rate)
        turn = jnp.where(control.yaw_known, control.yaw_rate * control.dt, bend)
        moved = lane.advance(distance, turn)
        rate = moved.rate * jnp.exp(-distance / self.straighten)
        lane = Lane(moved.offset, moved.heading, moved.curvature, rate)
        return RoadState(lane, state.width, state.pitch * jnp.exp(-control.dt / self.pitch_time))

    def covariance(self, state: RoadState, control: Ride) -> Float[Array, "6 6"]:
        """Process noise covariance of the six components."""
        time, way = control.dt, control.speed * control.dt
        rate = self.bend**2 * way
        swing = self.pitch**2 * (1.0 - jnp.exp(-2.0 * time / self.pitch_time))
        # The curvature is the integral of its rate, and wanders a little by itself.
        curvature = rate * way**2 / 3.0 + (3e-6) ** 2 * way
        parts = [self.offset**2 * time, self.heading**2 * time, curvature, rate, self.width**2 * way, swing]
        return jnp.diag(jnp.stack(parts).astype(state.width.dtype) + 1e-14)


class BorderSensor(Sensor):
    """Measurement model: image columns where the borders cross given rows.

    Args:
        ground: the camera with its mean pitch.
        rows: of the image, px.
        ranges: near which the rows show ground, m: where the search for the exact ones begins.
        sides: 1 for the left border, -1 for the right one.
        variances: of the measured columns, px^2.
    """

    ground: GroundCamera
    rows: Float[Array, " n"]
    ranges: Float[Array, " n"]
    sides: Float[Array, " n"]
    variances: Float[Array, " n"]

    def expect(self, state: RoadState, measurement: Float[Array, " n"]) -> Float[Array, " n"]:
        """The expected columns, with lens, roll and the pitch of the state."""
        camera = state.camera(self.ground)

        def project(x: Array) -> tuple[Array, Array]:
            return camera.project_components(x, state.border(x, self.sides))

        def step(_: Any, x: Array) -> Array:
            (_, row), (_, slope) = jax.jvp(project, (x,), (jnp.ones_like(x),))
            # Rows fall as ranges grow; a state far off must not throw the range behind the camera.
            moved = x - (row - self.rows) / lax.stop_gradient(jnp.minimum(slope, -1e-3))
            return jnp.clip(moved, 0.5 * x, 2.0 * x)

        # The last step alone has all of the derivative, as at any fixed point of Newton's iteration.
        near = lax.fori_loop(0, _STEPS, step, lax.stop_gradient(self.ranges))
        return project(step(None, lax.stop_gradient(near)))[0]

    def covariance(self, state: RoadState, measurement: Float[Array, " n"]) -> Float[Array, "n n"]:
        """Diagonal."""
        return jnp.diag(self.variances)
