"""Textured planes (floors, walls, signs) as maps, and their image in a camera."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxloc._arguments import checked
from jaxloc._jit import filter_jit
from jaxloc._linalg import matmul
from jaxloc.images.interpolation import AbstractInterpolation, Bilinear, sample
from jaxloc.images.warps import Homography
from jaxloc.poses import SE3
from jaxloc.sensors.camera import Pinhole


class Predicted(eqx.Module):
    """A predicted image.

    Attributes:
        image: gray levels; zero where the plane is not visible.
        seen: mask of the pixels of the plane.
    """

    image: Float[Array, "h w"]
    seen: Bool[Array, "h w"]


class TexturedPlane(eqx.Module):
    """A plane with an image Z as map; its appearance at a pose is ``z(x) = Z(T^-1 x)`` [K-11, K-45].

    The plane's axes lie in it: x along the rows of the image (to the right), y along its columns (down), so that z
    points away from the viewer; pixel (0, 0) has its center at the plane's origin.

    Args:
        texture: "rows columns", gray levels.
        resolution: edge of a pixel, m.
        T_world_plane: pose of the plane.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> plane = jl.sensors.TexturedPlane(jnp.ones((20, 30)), 0.1, jl.poses.SE3.identity())
        >>> plane.points(jnp.array([[10.0, 5.0]])).tolist()
        [[1.0, 0.5, 0.0]]
    """

    texture: Float[Array, "rows columns"]
    resolution: Float[Array, ""]
    T_world_plane: SE3

    def __init__(self, texture: Float[Array, "rows columns"], resolution: Any, T_world_plane: SE3):
        self.texture = texture
        self.resolution = jnp.asarray(resolution, texture.dtype)
        self.T_world_plane = T_world_plane

    @checked
    def points(self, pixels: Float[Array, "n 2"]) -> Float[Array, "n 3"]:
        """Points of the world (m) of pixels of the map (right, down)."""
        flat = jnp.concatenate([pixels * self.resolution, jnp.zeros_like(pixels[:, :1])], axis=1)
        return self.T_world_plane.apply(flat)

    @checked
    def homography(self, camera: Pinhole, T_world_camera: SE3) -> Homography:
        """Homography from pixels of the map to pixels of a camera without a lens: ``K [r1 r2 t] diag(s, s, 1)`` [K-17].

        Raises:
            ValueError: the camera has a lens: straight lines are not preserved.
        """
        if camera.lens is not None:
            raise ValueError("TexturedPlane.homography: the camera has a lens; undistort the image first.")
        matrix = (T_world_camera.inverse() @ self.T_world_plane).matrix()
        columns = jnp.stack([self.resolution * matrix[:3, 0], self.resolution * matrix[:3, 1], matrix[:3, 3]], axis=1)
        return Homography.from_matrix(matmul(camera.matrix(), columns))

    @filter_jit
    @checked
    def predict(
        self,
        camera: Pinhole,
        T_world_camera: SE3,
        *,
        shape: tuple[int, int],
        method: AbstractInterpolation = Bilinear(),
    ) -> Predicted:
        """The image of the plane in a camera.

        Args:
            camera: intrinsics and lens.
            T_world_camera: its pose.
            shape: rows and columns of the image; static.
            method: interpolation of the map.

        Returns:
            The image; differentiable in map, pose and camera.
        """
        u, v = jnp.meshgrid(*(jnp.arange(size, dtype=self.texture.dtype) for size in shape[::-1]))
        x, y = camera.normalize_components(u.reshape(-1), v.reshape(-1))
        T_plane_camera = self.T_world_plane.inverse() @ T_world_camera
        rays = matmul(jnp.stack([x, y, jnp.ones_like(x)], axis=1), T_plane_camera.rotation.matrix().T)
        center = T_plane_camera.translation
        # Intersection of the ray with z = 0; rays parallel to or away from the plane have none.
        depth = -center[2]
        meets = rays[:, 2] * depth > 1e-9 * jnp.abs(depth)
        reach = jnp.where(meets, depth / jnp.where(meets, rays[:, 2], 1.0), 0.0)
        there = (center[None, :2] + reach[:, None] * rays[:, :2]) / self.resolution
        values = sample(self.texture, there, method=method)
        seen = meets & values.inside
        return Predicted(jnp.where(seen, values.values, 0.0).reshape(shape), seen.reshape(shape))
