"""Both images at one scale, in coordinates that know no pixels: the template reaches from -1 to 1."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxloc._xla import compute_once
from jaxloc.alignment.lucas_kanade.brightness import Brightness
from jaxloc.alignment.lucas_kanade.scales import Scaled
from jaxloc.images.interpolation import AbstractInterpolation, sample_components
from jaxloc.images.warps import Homography, Similarity, Warp


class Frame(eqx.Module):
    """Template pixels x as ``y = (x - center) / radius``: unknowns of like size, and the same at every scale.

    Attributes:
        center: of the template, px of the full size.
        radius: half of its longer side, px.
    """

    center: tuple[float, float] = eqx.field(static=True)
    radius: float = eqx.field(static=True)

    @staticmethod
    def of(shape: tuple[int, int], normalized: bool = True) -> "Frame":
        """The frame of a template of rows and columns; if it is not normalized, pixels counted from one."""
        rows, columns = shape
        if not normalized:
            return Frame((-1.0, -1.0), 1.0)
        return Frame((0.5 * (columns - 1), 0.5 * (rows - 1)), max(0.5 * (max(shape) - 1), 0.5))

    def _to_pixels(self, dtype: Any) -> Similarity:
        u, v = self.center
        rows = np.array([[self.radius, 0.0, u], [0.0, self.radius, v], [0.0, 0.0, 1.0]])
        return Similarity(jnp.asarray(rows, dtype))

    def normalize(self, warp: Warp) -> Warp:
        """A warp of pixels as one of normalized coordinates."""
        outer = self._to_pixels(warp.matrix().dtype)
        return type(warp).of(outer.inverse() @ warp @ outer)

    def denormalize(self, warp: Warp) -> Warp:
        """A warp of normalized coordinates as one of pixels."""
        outer = self._to_pixels(warp.matrix().dtype)
        return type(warp).of(outer @ warp @ outer.inverse())

    def tangent_to_pixels(self, dof: int, dtype: Any) -> Float[Array, "d d"]:
        """The matrix that takes a tangent of normalized coordinates to one of pixels."""
        # The first directions of a homography are those of the smaller groups.
        return Homography.of(self._to_pixels(dtype)).adjoint()[:dof, :dof]


class Level(eqx.Module):
    """One scale, with the template's pixels along the last axis.

    Attributes:
        image: the image, with nan where there is none.
        channels: the image and its derivatives by u and v, where they are needed.
        image: the template, with nan where there is none.
        template: its values, n pixels, zero where there is none.
        u: normalized column of each template pixel.
        v: normalized row.
        weight: of each template pixel; zero where there is none.
        slope: derivative of the template by u and v, "2 n".
        columns: what brightness adds, "k n".
        spread: standard deviation of the template, gray levels, by which the first column is divided.
        frame: of the template.
        factor: pixels of the full size to one of this scale.
        shape: rows and columns of the template at this scale.
        correlating: whether brightness is that of the greatest correlation, or of the least squares.
    """

    image: Float[Array, "h w"]
    channels: Float[Array, "h w 3"] | None
    picture: Float[Array, "p q"]
    template: Float[Array, " n"]
    u: Float[Array, " n"]
    v: Float[Array, " n"]
    weight: Float[Array, " n"]
    slope: Float[Array, "2 n"]
    columns: Float[Array, "k n"]
    spread: Float[Array, ""]
    frame: Frame = eqx.field(static=True)
    factor: int = eqx.field(static=True)
    shape: tuple[int, int] = eqx.field(static=True)
    correlating: bool = eqx.field(static=True)

    @staticmethod
    def of(
        scaled: Scaled,
        weight: Float[Array, "p q"],
        frame: Frame,
        brightness: Brightness,
        *,
        differentiate_image: bool = False,
    ) -> "Level":
        """Prepares what does not change while the warp moves; weights are those of the full size."""
        image, template, factor, dtype = scaled.image, scaled.template, scaled.factor, scaled.template.dtype
        weight = weight[::factor, ::factor]
        rows, columns = template.shape
        u = (jnp.arange(columns, dtype=dtype) * factor - frame.center[0]) / frame.radius
        v = (jnp.arange(rows, dtype=dtype) * factor - frame.center[1]) / frame.radius
        grid_u, grid_v = jnp.meshgrid(u, v)
        slope = derivatives(template) * (frame.radius / factor)
        known = jnp.isfinite(template) & jnp.all(jnp.isfinite(slope), axis=0) & _interior(scaled)
        known = known & jnp.isfinite(weight) & (weight > 0)
        weight = jnp.where(known, weight, 0.0).reshape(-1)
        values = jnp.where(known, template, 0.0).reshape(-1)
        slope = compute_once(lambda slope: jnp.where(known[None], slope, 0.0).reshape(2, -1), slope)
        standard, spread = _standardize(values, weight)
        channels = None
        if differentiate_image:
            by_pixel = derivatives(image) * (frame.radius / factor)
            channels = jnp.stack([image, *by_pixel], axis=-1)
        return Level(
            image,
            channels,
            template,
            values,
            grid_u.reshape(-1),
            grid_v.reshape(-1),
            weight,
            slope,
            brightness.columns(standard),
            spread,
            frame,
            factor,
            (rows, columns),
            brightness.correlating,
        )

    def pixels(self, warp: Warp) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
        """Columns and rows of the template's pixels in the image of this scale."""
        u, v = warp.map_components(self.u, self.v)
        radius, (right, down) = self.frame.radius, self.frame.center
        return (u * radius + right) / self.factor, (v * radius + down) / self.factor

    def look(self, warp: Warp, method: AbstractInterpolation) -> "Seen":
        """The image under the warp."""
        values, inside = sample_components(self.image, *self.pixels(warp), method=method)
        known = inside & jnp.isfinite(values)
        return Seen(jnp.where(known, values, 0.0), known)

    def look_around(self, warp: Warp, method: AbstractInterpolation) -> "SeenSlope":
        """The image under the warp, and the derivatives of its interpolant by the image's pixels."""
        right, down = self.pixels(warp)

        def values(right: Float[Array, " n"], down: Float[Array, " n"]) -> Float[Array, " n"]:
            return sample_components(self.image, right, down, method=method)[0]

        one, zero = jnp.ones_like(right), jnp.zeros_like(right)
        seen = self.look(warp, method)
        slopes = [jax.jvp(values, (right, down), way)[1] for way in ((one, zero), (zero, one))]
        slope = jnp.stack(slopes) * (self.frame.radius / self.factor)
        return SeenSlope(seen.values, seen.known, jnp.where(seen.known[None], slope, 0.0))

    def look_with_slope(self, warp: Warp, method: AbstractInterpolation) -> "SeenSlope":
        """The image under the warp, and its derivatives by normalized coordinates, from differences of its pixels."""
        values, inside = sample_components(self.channels, *self.pixels(warp), method=method)
        known = inside & jnp.all(jnp.isfinite(values), axis=1)
        values = jnp.where(known[:, None], values, 0.0).T
        return SeenSlope(values[0], known, values[1:])


class Seen(eqx.Module):
    """The image at the template's pixels, and where there is one."""

    values: Float[Array, " n"]
    known: Bool[Array, " n"]


class SeenSlope(eqx.Module):
    """The image and its derivatives at the template's pixels, and where there are any."""

    values: Float[Array, " n"]
    known: Bool[Array, " n"]
    slope: Float[Array, "2 n"]


def derivatives(image: Float[Array, "h w"]) -> Float[Array, "2 h w"]:
    """By columns and by rows: central differences, one-sided along the border; zero along an axis of one pixel."""
    parts = [jnp.gradient(image, axis=axis) if image.shape[axis] > 1 else jnp.zeros_like(image) for axis in (1, 0)]
    return jnp.stack(parts)


def _interior(scaled: Scaled) -> Bool[Array, "p q"]:
    """Pixels that smoothing has not mixed with what lies beyond the border, and that have a central difference.

    A one-sided difference shares its noise with the pixel itself: all along the border that makes templates shrink.
    """
    rows, columns = scaled.template.shape
    margin = min(max(scaled.margin, 1), (min(rows, columns) - 1) // 4)
    inside = np.zeros((rows, columns), bool)
    inside[margin : rows - margin, margin : columns - margin] = True
    return jnp.asarray(inside)


def _standardize(values: Float[Array, " n"], weight: Float[Array, " n"]) -> tuple[Float[Array, " n"], Float[Array, ""]]:
    """Zero mean and unit variance under the weights; zero for a flat template."""
    total = jnp.sum(weight)
    total = jnp.where(total > 0, total, 1.0)
    mean = jnp.sum(weight * values) / total
    centered = jnp.where(weight > 0, values - mean, 0.0)
    variance = jnp.sum(weight * centered * centered) / total
    textured = variance > (8.0 * jnp.finfo(values.dtype).eps * jnp.abs(mean)) ** 2
    spread = jnp.sqrt(jnp.where(textured, variance, 1.0))
    return jnp.where(textured, centered / spread, 0.0), jnp.where(textured, spread, 0.0)
