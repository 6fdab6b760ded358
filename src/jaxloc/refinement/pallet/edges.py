"""Detection of the vertical edges of fork holes: level view, column profiles, edge pairs, candidates.

The edges of a hole are vertical and come in pairs: from the left, gray levels decrease to the hole and increase again.
The profile of a column is the mean of the horizontal derivative over a band of rows, where the gradient is mainly
horizontal. For a level camera at a known height, the rows of the holes depend on the range only, so every range has its
band.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxloc._arguments import checked
from jaxloc._jit import filter_jit
from jaxloc.images.gradients import central_difference, smooth
from jaxloc.images.interpolation import sample
from jaxloc.images.normalization import as_gray
from jaxloc.refinement.pallet.model import PalletType
from jaxloc.sensors import GroundCamera

# Fraction of the height of a hole that is used, without its blurred rims.
_INNER = 0.7
_PARTS = 4  # parts of an edge that are measured separately, for their scatter
_SMOOTHING = 1.0  # Gaussian blur before differentiation, px


class LevelView(eqx.Module):
    """An image rectified to a level camera without lens distortion: columns are bearings, rows elevations.

    Attributes:
        image: gray levels, smoothed by `smoothing`.
        slope: horizontal derivative, zero where the gradient is not mainly horizontal.
        focal: px.
        middle: (column, row) of the horizontal ray straight ahead, px.
        height: of the camera over the ground, m.
    """

    image: Float[Array, "h w"]
    slope: Float[Array, "h w"]
    focal: Float[Array, ""]
    middle: Float[Array, "2"]
    height: Float[Array, ""]

    @checked
    def rows(self, level: Float[Array, "*n"], x: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Rows of points at a height above the ground (m) and a distance (m)."""
        return self.middle[1] + self.focal * (self.height - level) / x


class Peaks(eqx.Module):
    """The strongest edges of one polarity in a profile.

    Attributes:
        columns: subpixel positions.
        strength: gray levels a pixel, zero in empty slots.
    """

    columns: Float[Array, " k"]
    strength: Float[Array, " k"]


class Candidate(eqx.Module):
    """Four edges of a candidate pallet.

    Attributes:
        columns: left to right, px.
        strength: of the weakest, gray levels a pixel; zero where there is none.
    """

    columns: Float[Array, "4"]
    strength: Float[Array, ""]


class MeasuredEdges(eqx.Module):
    """Four edges, measured each in its own rows.

    Attributes:
        columns: left to right, px.
        strength: of the weakest, gray levels a pixel.
        sigma: standard deviation of a column, px, from the scatter of parts of the edges.
    """

    columns: Float[Array, "4"]
    strength: Float[Array, ""]
    sigma: Float[Array, ""]


@filter_jit
def level_view(image: Any, camera: GroundCamera) -> LevelView:
    """Rectifies an image to a level camera without lens distortion.

    Args:
        image: grayscale image of any dtype.
        camera: with lens, height, pitch and roll.

    Returns:
        A view of the same size with the same center.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> camera = jl.sensors.GroundCamera(jl.sensors.Pinhole(60.0, 60.0, 31.5, 23.5), 0.5)
        >>> view = level_view(jnp.ones((48, 64)), camera)
        >>> view.image.shape, bool(jnp.all(view.slope == 0))
        ((48, 64), True)
    """
    gray = as_gray(image, camera.camera.fx.dtype)
    gray = jnp.where(jnp.isfinite(gray), gray, 0.0)
    rows, columns = gray.shape
    focal = camera.camera.fx
    middle = jnp.stack([camera.camera.cx, camera.camera.cy - focal * jnp.tan(camera.pitch)])
    u, v = (jnp.arange(size, dtype=gray.dtype) for size in (columns, rows))
    left = jnp.broadcast_to(-(u - middle[0])[None, :] / focal, gray.shape)
    up = jnp.broadcast_to(-(v - middle[1])[:, None] / focal, gray.shape)
    axes = camera.axes()
    x, y, z = (axes[0, i] + axes[1, i] * left + axes[2, i] * up for i in range(3))
    places = jnp.stack([c.reshape(-1) for c in camera.camera.project_components(x, y, z)], axis=1)
    level = sample(gray, places)
    inside = level.inside.reshape(gray.shape)
    smoothed = smooth(level.values.reshape(gray.shape), _SMOOTHING)
    return LevelView(smoothed, _principal(smoothed, inside), focal, middle, camera.height)


def _principal(image: Float[Array, "h w"], inside: Bool[Array, "h w"]) -> Float[Array, "h w"]:
    """Horizontal derivative where the gradient is mainly horizontal, zero outside the image."""
    slope = central_difference(image)
    whole = smooth(jnp.where(inside, 1.0, 0.0).astype(image.dtype), 1.0) > 0.999
    return jnp.where(whole & (jnp.abs(slope.right) >= jnp.abs(slope.down)), slope.right, 0.0)


@checked
def summed(slope: Float[Array, "h w"]) -> Float[Array, "h1 w"]:
    """Cumulative sums of rows: the mean over any band is the difference of two."""
    return jnp.concatenate([jnp.zeros_like(slope[:1]), jnp.cumsum(slope, axis=0)])


@checked
def band_profile(sums: Float[Array, "h1 w"], top: Float[Array, ""], bottom: Float[Array, ""]) -> Float[Array, " w"]:
    """Mean of each column between two rows, with fractions of rows; zero for bands outside the image."""
    high, low = (jnp.clip(row + 0.5, 0.0, sums.shape[0] - 1.0) for row in (top, bottom))
    inside = (low - high) > 0.5 * (bottom - top)

    def upto(row: Float[Array, ""]) -> Float[Array, " w"]:
        base = jnp.clip(jnp.floor(row).astype(int), 0, sums.shape[0] - 2)
        part = row - base.astype(row.dtype)
        pair = lax.dynamic_slice_in_dim(sums, base, 2)
        return (1.0 - part) * pair[0] + part * pair[1]

    length = jnp.where(inside, low - high, 1.0)
    return jnp.where(inside, (upto(low) - upto(high)) / length, 0.0)


@checked
def hole_band(view: LevelView, kind: PalletType, x: Float[Array, ""]) -> Float[Array, "2"]:
    """First and last row of the inner part of the holes of a pallet at a distance."""
    middle = kind.hole_bottom + 0.5 * kind.hole_height
    half = 0.5 * _INNER * kind.hole_height
    return jnp.stack([view.rows(middle + half, x), view.rows(middle - half, x)])


@checked
def strongest_edges(profile: Float[Array, " w"], count: int) -> Peaks:
    """The highest peaks of a profile, refined by a parabola through the logarithms of three columns.

    The derivative of a blurred step is a Gaussian, whose logarithm is a parabola: there is no bias. The positions have
    derivatives by the profile, for fixed columns of the peaks.
    """
    height = jnp.pad(profile, 1)
    middle = height[1:-1]
    peak = (middle > 0) & (middle >= height[:-2]) & (middle > height[2:])
    ranked = lax.stop_gradient(jnp.where(peak, middle, 0.0))
    strength, index = lax.top_k(ranked, count)
    found = strength > 0
    return Peaks(jnp.where(found, _vertex(height, index), 0.0), jnp.where(found, strength, 0.0))


@checked
def peak_near(profile: Float[Array, " w"], column: Float[Array, ""], radius: int) -> Peaks:
    """The highest peak of a profile within some pixels of a column, as a set of one.

    Raises:
        ValueError: a profile without pixels.
    """
    width = profile.shape[0]
    if not width:
        raise ValueError("peak_near: a profile without pixels.")
    places = jnp.arange(width, dtype=profile.dtype)
    near = jnp.abs(places - lax.stop_gradient(column)) <= radius
    index = jnp.argmax(lax.stop_gradient(jnp.where(near, profile, -jnp.inf)))
    height = jnp.pad(profile, 1)
    top, sides = height[index + 1], jnp.maximum(height[index], height[index + 2])
    found = (top > 0) & (top >= sides)
    return Peaks(
        jnp.where(found, _vertex(height, index[None]), column[None]),
        jnp.where(found, lax.stop_gradient(top), 0.0)[None],
    )


def _vertex(height: Float[Array, " w2"], index: Int[Array, " k"]) -> Float[Array, " k"]:
    """Column of the vertex of the parabola through three logarithms about an index of the unpadded profile."""
    values = [height[index + shift] for shift in range(3)]
    floor = jnp.maximum(1e-3 * values[1], float(jnp.finfo(height.dtype).tiny))
    left, middle, right = (jnp.log(jnp.maximum(value, floor)) for value in values)
    curvature = left - 2.0 * middle + right
    curved = curvature < -1e-6
    shift = jnp.where(curved, 0.5 * (left - right) / jnp.where(curved, curvature, 1.0), 0.0)
    return index.astype(height.dtype) + jnp.clip(shift, -1.0, 1.0)


@checked
def best_candidate(profile: Float[Array, " w"], kind: PalletType, span: Float[Array, ""], count: int) -> Candidate:
    """The four edges that fit a kind of pallet with the greatest strength of the weakest edge [K-74].

    The polarities alternate from the left; ``hole width : separation`` is that of the kind, at any range; both holes
    have nearly the same width; and the span is that of a pallet rotated by up to 45 degrees.

    Args:
        profile: mean horizontal derivative of the columns, gray levels a pixel.
        kind: of pallet.
        span: columns between the outer edges of a frontal pallet, px.
        count: candidates of each polarity; static.

    Returns:
        The candidate.
    """
    dark, light = strongest_edges(-profile, count), strongest_edges(profile, count)
    a, b = dark.columns[:, None, None, None], light.columns[None, :, None, None]
    c, d = dark.columns[None, None, :, None], light.columns[None, None, None, :]
    left, gap, right = b - a, c - b, d - c
    ordered = (left > 1.0) & (gap > 1.0) & (right > 1.0)
    left, gap, right = (jnp.where(ordered, part, 1.0) for part in (left, gap, right))
    ratio = 0.5 * (left + right) / gap
    foreshortening = (d - a) / span
    fits = ordered & (jnp.abs(jnp.log(ratio / kind.ratio())) < 0.15) & (jnp.abs(jnp.log(left / right)) < 0.5)
    fits = fits & (foreshortening > 0.6) & (foreshortening < 1.2)
    weakest = jnp.minimum(
        jnp.minimum(dark.strength[:, None, None, None], light.strength[None, :, None, None]),
        jnp.minimum(dark.strength[None, None, :, None], light.strength[None, None, None, :]),
    )
    score = jnp.where(fits, weakest, 0.0).reshape(-1)
    index = jnp.unravel_index(jnp.argmax(score), (count,) * 4)
    columns = [peaks.columns[i] for peaks, i in zip((dark, light, dark, light), index, strict=True)]
    return Candidate(jnp.stack(columns), jnp.max(score))


@checked
def edges_along(
    view: LevelView, sums: Float[Array, "h1 w"], kind: PalletType, columns: Float[Array, "4"], x: Float[Array, "4"]
) -> MeasuredEdges:
    """Measures four edges again, each in the rows of the hole at its own distance.

    Args:
        view: the image.
        sums: of its `slope`, by `summed`.
        kind: of pallet.
        columns: expected positions, px.
        x: distance of each edge, m.

    Returns:
        The edges.
    """
    signs = jnp.array([-1.0, 1.0, -1.0, 1.0], sums.dtype)
    parts = jnp.arange(_PARTS + 1, dtype=sums.dtype) / _PARTS

    def one(column: Array, distance: Array, sign: Array) -> tuple[Peaks, Array]:
        # Whole rows, which do not depend on the state in derivatives.
        band = jnp.round(lax.stop_gradient(hole_band(view, kind, distance)))

        def within(top: Array, bottom: Array) -> Peaks:
            return peak_near(sign * band_profile(sums, top, bottom), column, 4)

        rims = band[0] + (band[1] - band[0]) * parts
        return within(band[0], band[1]), jax.vmap(within)(rims[:-1], rims[1:]).columns[:, 0]

    whole, quarters = jax.vmap(one)(columns, x, signs)
    quarters = lax.stop_gradient(quarters)
    # The scatter is pooled over four edges: one edge alone has three degrees of freedom.
    scatter = jnp.sum((quarters - jnp.mean(quarters, axis=1, keepdims=True)) ** 2) / (4 * (_PARTS - 1))
    return MeasuredEdges(whole.columns[:, 0], jnp.min(whole.strength), jnp.sqrt(scatter / _PARTS))
