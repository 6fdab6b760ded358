"""Sensor model of moving objects in stereo images: position and velocity in the world."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxloc._arguments import checked
from jaxloc._linalg import matmul
from jaxloc.beliefs import Sensor
from jaxloc.poses import SE3
from jaxloc.poses.lie_group import as_floats
from jaxloc.sensors.stereo_rig import StereoRig

_NEAREST = 1.0  # depth below which the noise no longer decreases, m


class MovingObject(eqx.Module):
    """A measurement of a moving object.

    Attributes:
        position: in the world, m.
        velocity: in the world, m/s.
    """

    position: Float[Array, "3"]
    velocity: Float[Array, "3"]


class MovingObjectSensor(Sensor):
    """Position and velocity of the visible part of a rigid object, from a few points tracked over two frames.

    States are (position, velocity) in the world. Noise is that of the triangulation at the state, so it grows with the
    square of the depth; the unknown visible part of the object adds ``extent``. Position and velocity of one
    measurement share the error of the current frame; the error of the previous frame is shared with the previous
    measurement, which is accounted for by doubling the variance of the velocity.

    Args:
        rig: the stereo rig.
        pose: ``T_world_camera`` of this frame.
        pose_covariance: of the pose, right tangent.
        dt: time between both frames, s.
        sigma: standard deviation of a measured (u_left, u_right, v), px.
        points: number of independent points averaged.
        extent: standard deviation of the visible part's center in the object, m.
        slack: standard deviation of the velocity beyond the noise of the points, m/s.

    References:
        Thesis 4.3 and 5.4 [T-72], [T-78], [T-79]; rigid objects [T-12].
    """

    rig: StereoRig
    pose: SE3
    pose_covariance: Float[Array, "6 6"]
    dt: Float[Array, ""]
    sigma: Float[Array, ""]
    points: Float[Array, ""]
    extent: Float[Array, ""]
    slack: Float[Array, ""]

    def __init__(
        self,
        rig: StereoRig,
        pose: SE3,
        pose_covariance: Any,
        dt: Any,
        *,
        sigma: Any = 0.4,
        points: Any = 3.0,
        extent: Any = 0.7,
        slack: Any = 1.0,
    ):
        self.rig, self.pose, self.pose_covariance = rig, pose, pose_covariance
        self.dt, self.sigma, self.points, self.extent, self.slack = as_floats(dt, sigma, points, extent, slack)

    @checked
    def expect(self, state: Float[Array, "6"], measurement: Any) -> MovingObject:
        """The state itself."""
        del measurement
        return MovingObject(state[:3], state[3:])

    @checked
    def covariance(self, state: Float[Array, "6"], measurement: Any) -> Float[Array, "6 6"]:
        """Covariance of (position, velocity)."""
        del measurement
        place = self.pose.inverse().apply(state[None, :3])[0]
        place = place.at[2].set(jnp.maximum(place[2], _NEAREST))
        seen = self.rig.project(place[None])[0]
        jacobian = matmul(self.pose.rotation.matrix(), jax.jacfwd(lambda z: self.rig.triangulate(z[None])[0])(seen))
        noise = matmul(jacobian, jacobian.T) * (self.sigma**2 / self.points)
        eye = jnp.eye(3, dtype=noise.dtype)
        by_pose = self._pose_jacobian(place)
        transported = matmul(matmul(by_pose, self.pose_covariance), by_pose.T)
        cross = noise / self.dt
        position = noise + self.extent**2 * eye + transported
        velocity = 4.0 * noise / self.dt**2 + self.slack**2 * eye
        return jnp.block([[position, cross], [cross, velocity]])

    def linearize(self, state: Float[Array, "6"], measurement: Any) -> tuple[MovingObject, Float[Array, "6 6"]]:
        """The state and the identity matrix."""
        return self.expect(state, measurement), jnp.eye(6, dtype=state.dtype)

    def _pose_jacobian(self, place: Float[Array, "3"]) -> Float[Array, "3 6"]:
        """Jacobian of a point in the world by the right tangent of the pose: ``R [I, -[p]x]``."""
        x, y, z = place
        zero = jnp.zeros_like(x)
        cross = jnp.stack([jnp.stack(row) for row in ((zero, z, -y), (-z, zero, x), (y, -x, zero))])
        return matmul(self.pose.rotation.matrix(), jnp.concatenate([jnp.eye(3, dtype=place.dtype), cross], axis=1))
