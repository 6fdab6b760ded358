"""Metric raster: pixels of a plane and their coordinates in meters."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxloc._linalg import matmul
from jaxloc.images.warps import Euclidean
from jaxloc.poses import SE2


class Raster(eqx.Module):
    """A grid of square pixels on a plane: columns run along x, rows along y, seen from above.

    Args:
        origin: (x, y) of the center of pixel (0, 0), m.
        resolution: edge of a pixel, m.
        shape: rows and columns; static.

    Example:
        >>> import jax.numpy as jnp
        >>> raster = Raster(jnp.array([-1.0, 2.0]), 0.5, (4, 6))
        >>> raster.to_meters(jnp.array([[2.0, 1.0]])).tolist()
        [[0.0, 2.5]]
    """

    origin: Float[Array, "2"]
    resolution: Float[Array, ""]
    shape: tuple[int, int] = eqx.field(static=True)

    def __init__(self, origin: Float[Array, "2"], resolution: Any, shape: tuple[int, int]):
        if len(shape) != 2 or min(shape) < 1:
            raise ValueError(f"Raster: shape is {shape}; give the numbers of rows and columns.")
        self.origin = origin
        self.resolution = jnp.asarray(resolution, origin.dtype)
        self.shape = (int(shape[0]), int(shape[1]))

    @staticmethod
    def around(center: Float[Array, "2"], resolution: Any, shape: tuple[int, int]) -> "Raster":
        """Raster centered at a point."""
        middle = jnp.array([0.5 * (shape[1] - 1), 0.5 * (shape[0] - 1)], center.dtype)
        return Raster(center - middle * jnp.asarray(resolution, center.dtype), resolution, shape)

    def to_meters(self, pixels: Float[Array, "n 2"]) -> Float[Array, "n 2"]:
        """Points (x, y) of pixels (column, row)."""
        return self.origin[None] + self.resolution * pixels

    def to_pixels(self, points: Float[Array, "n 2"]) -> Float[Array, "n 2"]:
        """Pixels (column, row) of points (x, y)."""
        return (points - self.origin[None]) / self.resolution

    def centers(self) -> tuple[Float[Array, "h w"], Float[Array, "h w"]]:
        """Coordinates x and y of all pixels."""
        columns = jnp.arange(self.shape[1], dtype=self.origin.dtype)
        rows = jnp.arange(self.shape[0], dtype=self.origin.dtype)
        x, y = jnp.meshgrid(self.origin[0] + self.resolution * columns, self.origin[1] + self.resolution * rows)
        return x, y

    def corners(self) -> Float[Array, "4 2"]:
        """Centers of the corner pixels, m, in cyclic order."""
        right, top = self.shape[1] - 1.0, self.shape[0] - 1.0
        return self.to_meters(jnp.array([[0.0, 0.0], [right, 0.0], [right, top], [0.0, top]], self.origin.dtype))

    def warp(self, T_self_other: SE2, other: "Raster") -> Euclidean:
        """Warp from pixels of another raster, at a relative pose, to pixels of this one.

        Both must have one resolution: that of this one counts.
        """
        shift = (T_self_other.apply(other.origin[None])[0] - self.origin) / self.resolution
        return Euclidean(SE2.from_parts(T_self_other.rotation, shift).matrix())

    def pose(self, warp: Euclidean, other: "Raster") -> SE2:
        """The pose ``T_self_other`` of a warp: the inverse of `warp`."""
        matrix = warp.matrix()
        turned = matmul(matrix[:2, :2], other.origin)
        return SE2.from_matrix(matrix.at[:2, 2].set(self.origin + self.resolution * matrix[:2, 2] - turned))

    def tangent_to_meters(self) -> Float[Array, "3 3"]:
        """Matrix from tangents of a pixel warp to those of the pose (m, m, rad).

        A twist about pixel (0, 0) is one about the frame's origin with another velocity.
        """
        zero, one = jnp.zeros_like(self.resolution), jnp.ones_like(self.resolution)
        x, y = self.origin
        rows = ((self.resolution, zero, y), (zero, self.resolution, -x), (zero, zero, one))
        return jnp.stack([jnp.stack(row) for row in rows])
