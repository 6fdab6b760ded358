"""Image and template at one scale, in coordinates normalized to -1 to 1 over the template."""

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
    """Normalized coordinates ``y = (x - center) / radius`` of template pixels x, equal at every scale.

    Attributes:
        center: of the template, px of the full size.
        radius: half of its longer side, px.
    """

    center: tuple[float, float] = eqx.field(static=True)
    radius: float = eqx.field(static=True)

    @staticmethod
    def of(shape: tuple[int, int], normalized: bool = True) -> "Frame":
        """The frame of a template of (rows, columns); pixels counted from one if not normalized."""
        rows, columns = shape
        if not normalized:
            return Frame((-1.0, -1.0), 1.0)
        return Frame((0.5 * (columns - 1), 0.5 * (rows - 1)), max(0.5 * (max(shape) - 1), 0.5))

    def _to_pixels(self, dtype: Any) -> Similarity:
        u, v = self.center
        rows = np.array([[self.radius, 0.0, u], [0.0, self.radius, v], [0.0, 0.0, 1.0]])
        return Similarity(jnp.asarray(rows, dtype))

    def normalize(self, warp: Warp) -> Warp:
        """Converts a warp of pixels to normalized coordinates."""
        outer = self._to_pixels(warp.matrix().dtype)
        return type(warp).of(outer.inverse() @ warp @ outer)

    def denormalize(self, warp: Warp) -> Warp:
        """Converts a warp of normalized coordinates to pixels."""
        outer = self._to_pixels(warp.matrix().dtype)
        return type(warp).of(outer @ warp @ outer.inverse())

    def tangent_to_pixels(self, dof: int, dtype: Any) -> Float[Array, "d d"]:
        """Matrix that maps tangents of normalized coordinates to tangents of pixels."""
        # The first tangent directions of a homography are those of the smaller groups.
        return Homography.of(self._to_pixels(dtype)).adjoint()[:dof, :dof]


class Level(eqx.Module):
    """Image and template at one scale; template pixels along the last axis.

    Attributes:
        image: the image, nan where unknown.
        channels: the image and its derivatives by u and v, where they are needed.
        template_image: the template, nan where unknown.
        template: its values, n pixels, zero where unknown.
        u: normalized column of each template pixel.
        v: normalized row.
        weight: of each template pixel; zero where unknown.
        slope: derivative of the template by u and v, "2 n".
        columns: of the brightness model, "k n".
        contrast: standard deviation of the template, gray levels, by which the first column is divided.
        frame: of the template.
        factor: pixels of the full size to one of this scale.
        shape: rows and columns of the template at this scale.
        correlating: whether brightness maximizes correlation, or minimizes squares.
    """

    image: Float[Array, "h w"]
    channels: Float[Array, "h w 3"] | None
    template_image: Float[Array, "p q"]
    template: Float[Array, " n"]
    u: Float[Array, " n"]
    v: Float[Array, " n"]
    weight: Float[Array, " n"]
    slope: Float[Array, "2 n"]
    columns: Float[Array, "k n"]
    contrast: Float[Array, ""]
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
        """Prepares the parts that do not depend on the warp; weights are those of the full size."""
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
        standard, contrast = _standardize(values, weight)
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
            contrast,
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

    def sample(self, warp: Warp, method: AbstractInterpolation) -> "SampledImage":
        """The warped image."""
        values, inside = sample_components(self.image, *self.pixels(warp), method=method)
        known = inside & jnp.isfinite(values)
        return SampledImage(jnp.where(known, values, 0.0), known)

    def sample_with_interpolant_slope(self, warp: Warp, method: AbstractInterpolation) -> "SampledSlope":
        """The warped image, and derivatives of its interpolant, per pixel of the image."""
        right, down = self.pixels(warp)

        def values(right: Float[Array, " n"], down: Float[Array, " n"]) -> Float[Array, " n"]:
            return sample_components(self.image, right, down, method=method)[0]

        one, zero = jnp.ones_like(right), jnp.zeros_like(right)
        sampled = self.sample(warp, method)
        slopes = [jax.jvp(values, (right, down), way)[1] for way in ((one, zero), (zero, one))]
        slope = jnp.stack(slopes) * (self.frame.radius / self.factor)
        return SampledSlope(sampled.values, sampled.known, jnp.where(sampled.known[None], slope, 0.0))

    def sample_with_slope(self, warp: Warp, method: AbstractInterpolation) -> "SampledSlope":
        """The warped image, and its derivatives by normalized coordinates, from differences of pixels."""
        values, inside = sample_components(self.channels, *self.pixels(warp), method=method)
        known = inside & jnp.all(jnp.isfinite(values), axis=1)
        values = jnp.where(known[:, None], values, 0.0).T
        return SampledSlope(values[0], known, values[1:])


class SampledImage(eqx.Module):
    """The image at the template's pixels, and where it is known."""

    values: Float[Array, " n"]
    known: Bool[Array, " n"]


class SampledSlope(eqx.Module):
    """The image and its derivatives at the template's pixels, and where they are known."""

    values: Float[Array, " n"]
    known: Bool[Array, " n"]
    slope: Float[Array, "2 n"]


def derivatives(image: Float[Array, "h w"]) -> Float[Array, "2 h w"]:
    """Derivatives along rows and columns: central differences, one-sided at the border; zero along single pixels."""
    parts = [jnp.gradient(image, axis=axis) if image.shape[axis] > 1 else jnp.zeros_like(image) for axis in (1, 0)]
    return jnp.stack(parts)


def _interior(scaled: Scaled) -> Bool[Array, "p q"]:
    """Pixels unaffected by extrapolation beyond the border in smoothing, with central differences.

    The noise of a one-sided difference is correlated with that of its pixel, which along the border biases the scale.
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
    contrast = jnp.sqrt(jnp.where(textured, variance, 1.0))
    return jnp.where(textured, centered / contrast, 0.0), jnp.where(textured, contrast, 0.0)
