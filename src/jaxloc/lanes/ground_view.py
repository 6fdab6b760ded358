"""Inverse perspective mapping: the image resampled on a grid of the ground plane."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Num

from jaxloc._jit import filter_jit
from jaxloc.images.interpolation import Bilinear, sample_components
from jaxloc.images.normalization import as_gray
from jaxloc.poses.lie_group import as_floats
from jaxloc.sensors.ground_camera import GroundCamera

_NEAREST_RANGE = 1e-2  # m


class GroundGrid(eqx.Module):
    """Sampling grid on the ground: rows from near to far, columns from left to right.

    Args:
        ahead: "rows", ranges of the rows, m, increasing.
        left: "columns", lateral positions, m, evenly decreasing: the first column is the leftmost.
    """

    ahead: Float[Array, " rows"]
    left: Float[Array, " columns"]

    @staticmethod
    def between(near: Any, far: Any, width: Any, *, rows: int = 64, columns: int = 128) -> "GroundGrid":
        """A grid whose rows are spaced evenly in log range, between how the image and how the road would space them.

        Args:
            near: range of the first row, m.
            far: range of the last row, m.
            width: m of ground that every row shows, half to either side.
            rows: static.
            columns: static.

        Example:
            >>> import jaxloc as jl
            >>> grid = jl.lanes.ground_view.GroundGrid.between(5.0, 50.0, 8.0, rows=3, columns=5)
            >>> [round(x, 1) for x in grid.ahead.tolist()], grid.left.tolist()
            ([5.0, 15.8, 50.0], [4.0, 2.0, 0.0, -2.0, -4.0])
        """
        if rows < 2 or columns < 4:
            raise ValueError(f"GroundGrid.between got {rows} rows and {columns} columns; give at least 2 and 4.")
        near, far, width = as_floats(near, far, width)
        fraction = jnp.linspace(0.0, 1.0, rows, dtype=near.dtype)
        ahead = near * jnp.exp(fraction * jnp.log(far / near))
        return GroundGrid(ahead, width * (0.5 - jnp.linspace(0.0, 1.0, columns, dtype=near.dtype)))

    @staticmethod
    def for_speed(speed: Any, *, width: Any = 9.6, rows: int = 64, columns: int = 128) -> "GroundGrid":
        """Grid over the range that matters at a speed: from 5 m + 0.1 s of driving to 20 m + 2 s [K-34].

        Speeds are traced numbers: a new one does not recompile.

        Args:
            speed: of the vehicle, m/s.
            width: m of ground that every row shows.
            rows: static.
            columns: static.

        References:
            D. Pomerleau, "RALPH: rapidly adapting lateral position handler", 1995: the trapezoid's start and end depend
            on the velocity of the vehicle, its width on the ground does not [K-34].
        """
        speed, width = as_floats(speed, width)
        return GroundGrid.between(5.0 + 0.1 * speed, 20.0 + 2.0 * speed, width, rows=rows, columns=columns)

    @property
    def spacing(self) -> Float[Array, ""]:
        """Width of a column, m."""
        return (self.left[0] - self.left[-1]) / (self.left.size - 1)

    def column(self, left: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Column (fractional) of lateral positions."""
        return (self.left[0] - left) / self.spacing


class GroundView(eqx.Module):
    """Bird's-eye view of the ground.

    Attributes:
        image: gray levels, row by range and column by lateral position; zero where not visible.
        seen: where the ground is in the image.
        grid: where the samples lie.
        height: of the camera, m: needed for the change of ranges with the pitch.
    """

    image: Float[Array, "rows columns"]
    seen: Bool[Array, "rows columns"]
    grid: GroundGrid
    height: Float[Array, ""]

    def coarser(self) -> "GroundView":
        """Half as many columns, each the smoothed mean of its neighborhood, and every second row."""
        values, seen = halve_columns(self.image[::2], self.seen[::2])
        left = self.grid.left[: 2 * (self.grid.left.size // 2)].reshape(-1, 2)
        return GroundView(values, seen, GroundGrid(self.grid.ahead[::2], jnp.mean(left, axis=1)), self.height)

    def true_range(self, pitch: Float[Array, ""]) -> tuple[Float[Array, " rows"], Float[Array, " rows"]]:
        """Range of each row, and scale of its lateral positions, when the camera looked ``pitch`` further down.

        A change of pitch turns all rays about the vehicle's y axis, so that a row stays a row, with any lens and roll:
        ``x' = t (x cos p - h sin p)``, ``y' = t y``, ``t = h / (x sin p + h cos p)``. A row that then shows no ground
        gets an infinite range for all practical purposes (a thousand heights).

        Args:
            pitch: correction of the pitch the view was made with, rad, positive further down.
        """
        x, sine, cosine = self.grid.ahead, jnp.sin(pitch), jnp.cos(pitch)
        sink = x * sine + self.height * cosine
        scale = self.height / jnp.maximum(sink, 1e-3 * jnp.hypot(x, self.height))
        return scale * (x * cosine - self.height * sine), scale


def halve_columns(
    values: Float[Array, "*rows columns"], seen: Bool[Array, "*rows columns"]
) -> tuple[Float[Array, "*rows half"], Bool[Array, "*rows half"]]:
    """Rows smoothed by (1, 3, 3, 1) / 8 and halved: each new position lies between two old ones.

    Args:
        values: zero where not seen.
        seen: where they are known; a new one is where all four of its sources are (at the ends, those there are).
    """
    size = 2 * (values.shape[-1] // 2)
    padding = [(0, 0)] * (values.ndim - 1) + [(1, 1)]
    values = jnp.pad(values[..., :size], padding, mode="edge")
    seen = jnp.pad(seen[..., :size], padding, mode="edge")
    parts = [slice(i, size + i, 2) for i in range(3)] + [slice(3, size + 2, 2)]
    smooth = sum(w * values[..., part] for w, part in zip((0.125, 0.375, 0.375, 0.125), parts, strict=True))
    whole = seen[..., parts[0]] & seen[..., parts[1]] & seen[..., parts[2]] & seen[..., parts[3]]
    return jnp.where(whole, smooth, 0.0), whole


@filter_jit
def inverse_perspective(ground: GroundCamera, image: Num[Array, "h w"], grid: GroundGrid) -> GroundView:
    """Inverse perspective mapping: samples an image at the projections of the points of a ground grid.

    Args:
        ground: camera and its place over the road.
        image: gray image, bytes or floats.
        grid: points of the ground.

    Returns:
        The view, smoothed along its rows; what lies outside the image, or is not finite in it, is not seen.
        Differentiable in the image and in all numbers of the camera.

    References:
        [K-34], [K-35]; H. A. Mallot et al., "Inverse perspective mapping simplifies optical flow computation and
        obstacle detection", Biological Cybernetics 1991.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> ground = jl.sensors.GroundCamera(jl.sensors.Pinhole(500.0, 500.0, 320.0, 240.0), height=1.5)
        >>> grid = jl.lanes.ground_view.GroundGrid.for_speed(20.0)
        >>> view = jl.lanes.ground_view.inverse_perspective(ground, jnp.full((480, 640), 7.0), grid)
        >>> view.image.shape, bool(jnp.all(view.image[view.seen] == 7.0))
        ((64, 128), True)
    """
    pixels = as_gray(image)
    # Twice as many columns, then halved: a mark is not much wider than a column, and would alias.
    quarter = 0.25 * grid.spacing
    fine = jnp.stack([grid.left + quarter, grid.left - quarter], axis=1).ravel()
    x = jnp.broadcast_to(grid.ahead[:, None], (grid.ahead.size, fine.size)).astype(pixels.dtype)
    y = jnp.broadcast_to(fine[None, :], x.shape).astype(pixels.dtype)
    u, v = ground.project_components(x, y)
    known = jnp.isfinite(pixels)
    values, inside = sample_components(jnp.where(known, pixels, 0.0), u.ravel(), v.ravel(), method=Bilinear())
    # A pixel that is not finite spoils every sample that has a share in it.
    share, _ = sample_components(lax.stop_gradient(known.astype(pixels.dtype)), u.ravel(), v.ravel(), method=Bilinear())
    seen = inside.reshape(x.shape) & (share.reshape(x.shape) > 0.999)
    seen &= ground.sees_components(x, y) & (x > _NEAREST_RANGE)
    values, seen = halve_columns(jnp.where(seen, values.reshape(x.shape), 0.0), seen)
    return GroundView(values, seen, grid, ground.height.astype(pixels.dtype))
