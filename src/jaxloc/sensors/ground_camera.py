"""Camera over a ground plane: projection of ground points and back-projection of pixels."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxloc._arguments import checked
from jaxloc._linalg import matmul
from jaxloc.poses import SE3, SO3
from jaxloc.poses.lie_group import as_floats
from jaxloc.sensors.camera import Pinhole

_GRAZING = 1e-4  # least slope of rays that intersect the ground


class GroundCamera(eqx.Module):
    """A camera fixed to a vehicle, with height, pitch and roll relative to the ground plane.

    The road frame has x forward, y left, z up, and its origin on the ground straight below the camera.

    Args:
        camera: intrinsics and lens.
        height: of the camera over the ground, m.
        pitch: of the optical axis below the horizontal, rad, positive downwards.
        roll: about the optical axis, clockwise seen from behind, rad: positive has the right side down.

    References:
        D. Pomerleau, "RALPH: rapidly adapting lateral position handler", Intelligent Vehicles 1995 [K-34], [K-35];
        R. Hartley and A. Zisserman, *Multiple View Geometry*, 2004, section 8.1 (the homography of a plane).

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> ground = jl.sensors.GroundCamera(jl.sensors.Pinhole(500.0, 500.0, 320.0, 240.0), height=1.5)
        >>> [float(c[0]) for c in ground.project_components(jnp.array([15.0]), jnp.array([3.0]))]
        [220.0, 290.0]
    """

    camera: Pinhole
    height: Float[Array, ""]
    pitch: Float[Array, ""]
    roll: Float[Array, ""]

    def __init__(self, camera: Pinhole, height: Any, pitch: Any = 0.0, roll: Any = 0.0):
        self.camera = camera
        self.height, self.pitch, self.roll = as_floats(height, pitch, roll)

    def axes(self) -> Float[Array, "3 3"]:
        """The camera's right, down and forward axes in the road frame, as columns."""
        sp, cp, sr, cr = jnp.sin(self.pitch), jnp.cos(self.pitch), jnp.sin(self.roll), jnp.cos(self.roll)
        zero = jnp.zeros_like(sp)
        rows = [[-sr * sp, -cr * sp, cp], [-cr, sr, zero], [-sr * cp, -cr * cp, -sp]]
        return jnp.stack([jnp.stack(row) for row in rows])

    def T_road_camera(self) -> SE3:
        """Pose of the camera in the road frame."""
        zero = jnp.zeros_like(self.height)
        return SE3(SO3(self.axes()), jnp.stack([zero, zero, self.height]))

    def homography(self) -> Float[Array, "3 3"]:
        """Homogeneous points of the ground (x forward, y left, m) to pixels of a camera without a lens [K-35].

        It reverses orientation (y is to the left), so it is a matrix and not a warp of `images.warps`.

        Raises:
            ValueError: the camera has a lens: straight lines are not preserved.
        """
        if self.camera.lens is not None:
            raise ValueError("GroundCamera.homography: the camera has a lens; undistort the image first.")
        axes = self.axes()
        ground = jnp.stack([axes[0], axes[1], -self.height * axes[2]], axis=1)
        return matmul(self.camera.matrix(), ground)

    def camera_components(self, x: Float[Array, "*n"], y: Float[Array, "*n"]) -> tuple[Array, Array, Array]:
        """Points of the ground in the camera frame."""
        axes = self.axes()
        right, down, forward = (axes[0, i] * x + axes[1, i] * y - self.height * axes[2, i] for i in range(3))
        return right, down, forward

    def project_components(
        self, x: Float[Array, "*n"], y: Float[Array, "*n"]
    ) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
        """Pixels (u right, v down) of points of the ground; the principal point where `sees_components` is false.

        Args:
            x: forward, m, array of any shape.
            y: left, m, of the same shape.
        """
        return self.camera.project_components(*self.camera_components(x, y))

    def sees_components(self, x: Float[Array, "*n"], y: Float[Array, "*n"]) -> Bool[Array, "*n"]:
        """Whether points of the ground are in front of the camera, where its lens is one-to-one (not: in the image)."""
        return self.camera.in_front_components(*self.camera_components(x, y))

    def to_ground_components(
        self, u: Float[Array, "*n"], v: Float[Array, "*n"]
    ) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
        """Points of the ground (x forward, y left, m) at pixels; zero where `meets_ground_components` is false."""
        toward, meets = self._rays(u, v)
        reach = jnp.where(meets, self.height / jnp.where(meets, -toward[2], 1.0), 0.0)
        return reach * toward[0], reach * toward[1]

    def meets_ground_components(self, u: Float[Array, "*n"], v: Float[Array, "*n"]) -> Bool[Array, "*n"]:
        """Whether rays through pixels intersect the ground: below the horizon."""
        return self._rays(u, v)[1]

    @checked
    def vanishing_point(self, heading: Float[Array, ""]) -> Float[Array, "2"]:
        """Vanishing point of lines on the ground in a direction, px.

        Args:
            heading: counter-clockwise from straight ahead, rad.
        """
        along = jnp.stack([jnp.cos(heading), jnp.sin(heading), jnp.zeros_like(heading)])
        return jnp.stack(self.camera.project_components(*matmul(self.axes().T, along)))

    def horizon(self) -> Float[Array, ""]:
        """Row of the horizon straight ahead, px."""
        return self.vanishing_point(jnp.zeros_like(self.pitch))[1]

    def _rays(self, u: Array, v: Array) -> tuple[list[Array], Array]:
        """Rays in the road frame, and whether they intersect the ground."""
        a, b = self.camera.normalize_components(u, v)
        axes = self.axes()
        toward = [axes[i, 0] * a + axes[i, 1] * b + axes[i, 2] for i in range(3)]
        return toward, toward[2] < -_GRAZING
