"""Rectified stereo rig: projection and triangulation."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxloc._arguments import checked
from jaxloc._jit import filter_jit
from jaxloc.sensors.camera import Pinhole

_SMALLEST = 1e-6  # least disparity with a depth, px


class StereoRig(eqx.Module):
    """A rectified stereo pair: two equal cameras, the right one displaced by ``baseline`` along +x.

    A measurement is ``(u_left, u_right, v)`` with ``u_right = u_left - fx B / z``.

    Args:
        camera: the left camera, without lens (images are rectified).
        baseline: distance B of the two centers, m.

    Raises:
        ValueError: if the camera has a lens.

    References:
        Thesis eq. 2.14-2.19 [T-22], [T-23]; review eq. 18 [R-43].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> rig = jl.sensors.StereoRig(jl.sensors.Pinhole(700.0, 700.0, 600.0, 180.0), baseline=0.5)
        >>> measured = rig.project(jnp.array([[2.0, 1.0, 10.0]]))
        >>> measured.tolist(), rig.triangulate(measured).tolist()
        ([[740.0, 705.0, 250.0]], [[2.0, 1.0, 10.0]])
    """

    camera: Pinhole
    baseline: Float[Array, ""]

    def __init__(self, camera: Pinhole, baseline: Any):
        if camera.lens is not None:
            raise ValueError("StereoRig got a camera with a lens: rectify the images first and leave the lens out.")
        self.camera = camera
        self.baseline = jnp.asarray(baseline, camera.fx.dtype)

    @filter_jit
    @checked
    def project(self, points: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
        """Measurements (u_left, u_right, v), px, of points "n 3" in the left camera's frame, m [T-22]."""
        return self.project_components(points[:, 0], points[:, 1], points[:, 2]).T

    def project_components(
        self, x: Float[Array, "*n"], y: Float[Array, "*n"], z: Float[Array, "*n"]
    ) -> Float[Array, "3 *n"]:
        """`project` on component arrays of any shape: (u_left, u_right, v) along the first axis."""
        u_left, v = self.camera.project_components(x, y, z)
        front = self.in_front_components(x, y, z)
        disparity = self.camera.fx * self.baseline / jnp.where(front, z, 1.0)
        return jnp.stack([u_left, u_left - jnp.where(front, disparity, 0.0), v])

    @checked
    def in_front(self, points: Float[Array, "n 3"]) -> Bool[Array, " n"]:
        """Whether points are projected (see `Pinhole.in_front`)."""
        return self.camera.in_front(points)

    def in_front_components(
        self, x: Float[Array, "*n"], y: Float[Array, "*n"], z: Float[Array, "*n"]
    ) -> Bool[Array, "*n"]:
        """`in_front` on component arrays."""
        return self.camera.in_front_components(x, y, z)

    @filter_jit
    @checked
    def triangulate(self, measurements: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
        """Points of the left camera's frame, the exact inverse of `project`.

        ``z = fx B / d``, ``y = z (v - cy) / fy``, ``x = z ((u_left - cx) - skew y / z) / fx`` with
        ``d = u_left - u_right`` [T-23], [R-43].

        Args:
            measurements: "n 3" (u_left, u_right, v), px.

        Returns:
            Points "n 3", m. Without disparity (see `has_depth`) the point is that of d = 1 px, with zero gradient.
        """
        seen = self.has_depth(measurements)
        u_left, u_right, v = (jnp.where(seen, measurements[:, i], 0.0) for i in range(3))
        z = self.camera.fx * self.baseline / jnp.where(seen, u_left - u_right, 1.0)
        x, y = self.camera.normalize_components(u_left, v)
        return jnp.stack([x * z, y * z, z], axis=-1)

    @checked
    def has_depth(self, measurements: Float[Array, "n 3"]) -> Bool[Array, " n"]:
        """Whether measurements have a positive disparity."""
        return measurements[:, 0] - measurements[:, 1] > _SMALLEST
