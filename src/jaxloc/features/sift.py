"""SIFT in JAX: blobs over scale, their orientations, and descriptors of 128 numbers, all differentiable.

OpenCV's SIFT (`images.detect` with ``SIFT()``) is several times as fast on a CPU; this one runs on accelerators and in
batches, and has derivatives: of places and scales by the interpolated extrema, of descriptors by the image.
"""

import math
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxloc.features.keypoints import Descriptors, Keypoints
from jaxloc.features.scale_space.extrema import ExtremumTest, find_extrema
from jaxloc.features.scale_space.gaussian import Octave, ScaleSpace, octaves

_BINS = 36
# Radius of the orientation's window and width of a descriptor's cell, in blurs of the keypoint.
_WINDOW, _CELL = 4.5, 3.0
# Samples along a side of the descriptor, cells along a side, directions.
_SAMPLES, _CELLS, _DIRECTIONS = 16, 4, 8
_CLIP = 0.2


class Sift(eqx.Module):
    """What SIFT looks for.

    Attributes:
        scales: the scale space.
        least_contrast: least response of a keypoint times the layers of an octave, as a share of 255 gray levels.
        edge_ratio: greatest ratio of principal curvatures.
        orientations: directions that a keypoint may have; each fills a slot of its own.
        second_peak: share of the highest peak that another one needs.

    References:
        Lowe, "Distinctive image features from scale-invariant keypoints", IJCV 2004.
    """

    scales: ScaleSpace = ScaleSpace()
    least_contrast: float = eqx.field(static=True, default=0.04)
    edge_ratio: float = eqx.field(static=True, default=10.0)
    orientations: int = eqx.field(static=True, default=2)
    second_peak: float = eqx.field(static=True, default=0.8)


class _Slopes(NamedTuple):
    """Derivatives of all layers of all octaves, one after the other, and where each layer lies.

    Attributes:
        right: central differences along rows, gray levels a pixel of the octave.
        down: along columns.
        start: first entry of each (octave, layer).
        shape: (rows, columns) of each octave.
        step: of each octave, px of the image.
    """

    right: Float[Array, " m"]
    down: Float[Array, " m"]
    start: Int[Array, "o s"]
    shape: Int[Array, "o 2"]
    step: Float[Array, " o"]


@eqx.filter_jit
def sift(image: Float[Array, "h w"], *, options: Sift = Sift(), capacity: int = 1000) -> tuple[Keypoints, Descriptors]:
    """Keypoints with scale and orientation, and their descriptors.

    Args:
        image: gray levels 0-255.
        options: what to look for.
        capacity: keypoints that are kept, the strongest first; there are ``options.orientations`` slots for each.

    Returns:
        Keypoints (``size`` is twice the blur, as in OpenCV) and their descriptors of length one.

    References:
        Lowe 2004; review sections 4.3-4.4 [R-27, R-28, R-31]; thesis section 2.2.2 [T-29...T-35].

    Example:
        >>> import jax.numpy as jnp
        >>> u, v = jnp.meshgrid(jnp.arange(64.0), jnp.arange(64.0))
        >>> image = 60 + 120 * jnp.exp(-((u - 30.3) ** 2 + 2.0 * (v - 33.6) ** 2) / 32)
        >>> keypoints, descriptors = sift(image, capacity=4)
        >>> [round(float(x), 1) for x in keypoints.uv[0]], descriptors.values.shape
        ([30.3, 33.6], (8, 128))
    """
    finite = jnp.isfinite(image)
    stacks = octaves(jnp.where(finite, image, 0.0), options.scales)
    slopes = _slopes_of(stacks)
    uv, sigma, value, valid = _strongest(stacks, options, capacity)
    angles, peaks = _orientations(slopes, uv, sigma, options)
    # The first orientation of all, then the second of all.
    several = options.orientations
    uv, sigma, value = jnp.tile(uv, (several, 1)), jnp.tile(sigma, several), jnp.tile(value, several)
    valid = (jnp.tile(valid, (several, 1)) & peaks.T).reshape(-1)
    angle = jnp.where(valid, angles.T.reshape(-1), 0.0)
    none = jnp.zeros(valid.shape, jnp.int32)
    uv, size = jnp.where(valid[:, None], uv, 0.0), jnp.where(valid, 2.0 * sigma, 0.0)
    keypoints = Keypoints(uv, size, angle, jnp.where(valid, value, 0.0), none, none, valid, "sift")
    return keypoints, _describe(slopes, keypoints, options.scales)


@eqx.filter_jit
def describe_sift(
    image: Float[Array, "h w"], keypoints: Keypoints, *, scales: ScaleSpace = ScaleSpace()
) -> Descriptors:
    """SIFT's descriptors of any keypoints with a size and an angle.

    Gradients on a grid of 16 x 16 samples, turned and scaled with the keypoint, are collected in 4 x 4 cells of 8
    directions, every sample shared among its neighbors, under a Gaussian window.

    Args:
        image: gray levels.
        keypoints: `size` is twice the blur at which the image is read.
        scales: the scale space.

    Returns:
        128 numbers a keypoint, of length one; zero where not valid.

    References:
        Lowe 2004, section 6 [R-31, T-35].

    Example:
        >>> import jax, jax.numpy as jnp
        >>> image = jax.random.uniform(jax.random.key(0), (64, 64), maxval=255.0)
        >>> found = describe_sift(image, Keypoints.from_uv(jnp.array([[30.0, 30.0]]), size=8.0))
        >>> found.values.shape, round(float(jnp.linalg.norm(found.values)), 3)
        ((1, 128), 1.0)
    """
    return _describe(_slopes_of(octaves(image, scales)), keypoints, scales)


def _strongest(stacks: tuple[Octave, ...], options: Sift, capacity: int) -> tuple[Array, Array, Array, Array]:
    """Places, blurs, responses and validity of the strongest extrema of all octaves."""
    scales, layers = options.scales, options.scales.octave_layers
    test = ExtremumTest(255.0 * options.least_contrast / layers, options.edge_ratio)
    parts = []
    for octave in stacks:
        found = find_extrema(octave.differences, test, capacity=capacity)
        sigma = scales.sigma * octave.step * jnp.exp2(found.place[:, 0] / layers)
        parts.append((octave.step * found.place[:, :0:-1], sigma, jnp.abs(found.value), found.valid))
    uv, sigma, value, valid = (jnp.concatenate(column) for column in zip(*parts, strict=True))
    _, best = lax.top_k(lax.stop_gradient(jnp.where(valid, value, -1.0)), capacity)
    return uv[best], sigma[best], value[best], valid[best]


def _slopes_of(stacks: tuple[Octave, ...]) -> _Slopes:
    right, down, starts, start = [], [], [], 0
    for octave in stacks:
        layers, (_, height, width) = octave.layers, octave.layers.shape
        wide = jnp.pad(layers, ((0, 0), (1, 1), (1, 1)), mode="edge")
        right.append(0.5 * (wide[:, 1:-1, 2:] - wide[:, 1:-1, :-2]).reshape(-1))
        down.append(0.5 * (wide[:, 2:, 1:-1] - wide[:, :-2, 1:-1]).reshape(-1))
        starts.append([start + k * height * width for k in range(layers.shape[0])])
        start += layers.size
    dtype = stacks[0].layers.dtype
    shapes, steps = [octave.layers.shape[1:] for octave in stacks], [octave.step for octave in stacks]
    tables = jnp.asarray(np.array(starts), jnp.int32), jnp.asarray(np.array(shapes), jnp.int32)
    return _Slopes(jnp.concatenate(right), jnp.concatenate(down), *tables, jnp.asarray(steps, dtype))


class _Seat(NamedTuple):
    """The layer that belongs to a keypoint, and the keypoint there, in samples.

    Attributes:
        start: first entry of the layer.
        shape: (rows, columns).
        uv: "n 2".
        sigma: blur.
    """

    start: Int[Array, " n"]
    shape: Int[Array, "n 2"]
    uv: Float[Array, "n 2"]
    sigma: Float[Array, " n"]


def _seat(slopes: _Slopes, uv: Array, sigma: Array, scales: ScaleSpace) -> _Seat:
    layers, first = scales.octave_layers, scales.sigma * (0.5 if scales.doubled else 1.0)
    level = layers * jnp.log2(jnp.maximum(lax.stop_gradient(sigma), 1e-3) / first)
    octave = jnp.clip(jnp.floor((level - 0.5) / layers), 0, slopes.step.shape[0] - 1).astype(jnp.int32)
    layer = jnp.clip(jnp.round(level - layers * octave.astype(level.dtype)), 0, layers + 2).astype(jnp.int32)
    step = slopes.step[octave]
    return _Seat(slopes.start[octave, layer], slopes.shape[octave], uv / step[:, None], sigma / step)


def _orientations(slopes: _Slopes, uv: Array, sigma: Array, options: Sift) -> tuple[Array, Bool[Array, "n k"]]:
    """Directions of the highest peaks of the histogram of gradients, and which are high enough.

    References:
        Lowe 2004, section 5 [T-33, T-34].
    """
    seat = _seat(slopes, uv, sigma, options.scales)
    reach = math.ceil(_WINDOW * options.scales.sigma * 2.0 ** (1.0 + 0.5 / options.scales.octave_layers))
    side = jnp.arange(-reach, reach + 1, dtype=jnp.int32)
    middle = jnp.round(lax.stop_gradient(seat.uv)).astype(jnp.int32)
    column, row = middle[:, 0, None] + side[None, :], middle[:, 1, None] + side[None, :]
    height, width = seat.shape[:, 0, None], seat.shape[:, 1, None]
    inside = ((row > 0) & (row < height - 1))[:, :, None] & ((column > 0) & (column < width - 1))[:, None, :]
    flat = (jnp.clip(row, 0, height - 1) * width)[:, :, None] + jnp.clip(column, 0, width - 1)[:, None, :]
    flat = flat + seat.start[:, None, None]
    spread = (side.astype(sigma.dtype) / (_WINDOW / 3.0))[None, :] / seat.sigma[:, None]
    near = jnp.abs(side)[None, :] <= jnp.round(_WINDOW * lax.stop_gradient(seat.sigma)).astype(jnp.int32)[:, None]
    window = jnp.where(near, jnp.exp(-0.5 * spread**2), 0.0)
    weight = jnp.where(inside, window[:, :, None] * window[:, None, :], 0.0).reshape(len(uv), -1)
    flat = flat.reshape(len(uv), -1)
    magnitude, angle = _polar(slopes.right[flat], slopes.down[flat])
    return _peaks(_smoothed(_histogram(weight * magnitude, angle)), options)


def _polar(right: Array, down: Array) -> tuple[Array, Array]:
    """Length and direction, with safe derivatives where there is no gradient."""
    squared = right * right + down * down
    some = squared > 0
    length = jnp.where(some, jnp.sqrt(jnp.where(some, squared, 1.0)), 0.0)
    return length, jnp.arctan2(jnp.where(some, down, 0.0), jnp.where(some, right, 1.0))


def _histogram(weight: Float[Array, "n m"], angle: Float[Array, "n m"]) -> Float[Array, "n 36"]:
    """Weights by direction, each shared between the two nearest bins."""
    position = angle * (_BINS / (2.0 * math.pi))
    low = jnp.floor(lax.stop_gradient(position))
    part, index = position - low, low.astype(jnp.int32) % _BINS
    rows = jnp.arange(len(weight))[:, None]
    empty = jnp.zeros((len(weight), _BINS), weight.dtype)
    return empty.at[rows, index].add(weight * (1.0 - part)).at[rows, (index + 1) % _BINS].add(weight * part)


def _smoothed(histogram: Float[Array, "n 36"]) -> Float[Array, "n 36"]:
    kernel = {-2: 1 / 16, -1: 4 / 16, 0: 6 / 16, 1: 4 / 16, 2: 1 / 16}
    return sum(weight * jnp.roll(histogram, shift, axis=1) for shift, weight in kernel.items())


def _peaks(histogram: Float[Array, "n 36"], options: Sift) -> tuple[Float[Array, "n k"], Bool[Array, "n k"]]:
    """Highest local maxima, at the vertex of the parabola through three bins [T-34]."""
    before, after = jnp.roll(histogram, 1, axis=1), jnp.roll(histogram, -1, axis=1)
    maximal = (histogram > before) & (histogram > after)
    height, index = lax.top_k(lax.stop_gradient(jnp.where(maximal, histogram, 0.0)), options.orientations)
    left, middle, right = (jnp.take_along_axis(values, index, axis=1) for values in (before, histogram, after))
    bend = left - 2.0 * middle + right
    bent = bend < 0
    offset = jnp.where(bent, 0.5 * (left - right) / jnp.where(bent, bend, 1.0), 0.0)
    angle = (index.astype(histogram.dtype) + offset) * (2.0 * math.pi / _BINS)
    high = (height > 0) & (height >= options.second_peak * height[:, :1])
    return jnp.where(high, angle, 0.0), high


def _describe(slopes: _Slopes, keypoints: Keypoints, scales: ScaleSpace) -> Descriptors:
    sigma = jnp.where(keypoints.valid, 0.5 * keypoints.size, 1.0)
    seat = _seat(slopes, keypoints.uv, sigma, scales)
    grid = (jnp.arange(_SAMPLES, dtype=sigma.dtype) + 0.5) * (_CELLS / _SAMPLES) - 0.5 * _CELLS
    down, right = (axis.reshape(-1) for axis in jnp.meshgrid(grid, grid, indexing="ij"))
    cos, sin = (f(keypoints.angle)[:, None] * _CELL * seat.sigma[:, None] for f in (jnp.cos, jnp.sin))
    u = seat.uv[:, :1] + cos * right[None, :] - sin * down[None, :]
    v = seat.uv[:, 1:] + sin * right[None, :] + cos * down[None, :]
    gradient, inside = _read(slopes, seat, u, v)
    magnitude, angle = _polar(*gradient)
    # The Gaussian window is as wide as half the descriptor.
    window = jnp.exp(-(right**2 + down**2) / (2.0 * (0.5 * _CELLS) ** 2))
    weight = jnp.where(inside, magnitude * window[None, :], 0.0)
    # Counter-clockwise on the screen, as OpenCV counts them: descriptors of both may be matched.
    turn = (keypoints.angle[:, None] - angle) * (_DIRECTIONS / (2.0 * math.pi))
    cells = _cells(grid)
    parts = []
    for direction in range(_DIRECTIONS):
        apart = jnp.abs((turn - direction + 0.5 * _DIRECTIONS) % _DIRECTIONS - 0.5 * _DIRECTIONS)
        parts.append((weight * jnp.maximum(1.0 - apart, 0.0)) @ cells)
    values = _unit(jnp.minimum(_unit(jnp.stack(parts, axis=2).reshape(len(sigma), -1)), _CLIP))
    valid = keypoints.valid & (jnp.sum(weight, axis=1) > 0)
    return Descriptors(jnp.where(valid[:, None], values, 0.0), valid)


def _cells(grid: Float[Array, " s"]) -> Float[Array, "s2 c2"]:
    """Shares of each sample in the cells: linear along both axes."""
    centers = jnp.arange(_CELLS, dtype=grid.dtype) + (0.5 - 0.5 * _CELLS)
    share = jnp.maximum(1.0 - jnp.abs(grid[:, None] - centers[None, :]), 0.0)
    return (share[:, None, :, None] * share[None, :, None, :]).reshape(len(grid) ** 2, -1)


def _read(slopes: _Slopes, seat: _Seat, u: Array, v: Array) -> tuple[tuple[Array, Array], Array]:
    """Derivatives between samples of each keypoint's layer, and which samples lie inside."""
    height, width = seat.shape[:, :1], seat.shape[:, 1:]
    column, row = jnp.floor(lax.stop_gradient(u)), jnp.floor(lax.stop_gradient(v))
    part_u, part_v = u - column, v - row
    column, row = column.astype(jnp.int32), row.astype(jnp.int32)
    inside = (column >= 0) & (row >= 0) & (column < width - 1) & (row < height - 1)
    flat = seat.start[:, None] + jnp.clip(row, 0, height - 2) * width + jnp.clip(column, 0, width - 2)
    corners = (
        (flat, (1.0 - part_u) * (1.0 - part_v)),
        (flat + 1, part_u * (1.0 - part_v)),
        (flat + width, (1.0 - part_u) * part_v),
        (flat + width + 1, part_u * part_v),
    )
    right, down = (sum(values[index] * share for index, share in corners) for values in (slopes.right, slopes.down))
    return (right, down), inside


def _unit(values: Float[Array, "n d"]) -> Float[Array, "n d"]:
    squared = jnp.sum(values * values, axis=1, keepdims=True)
    some = squared > 0
    return values / jnp.sqrt(jnp.where(some, squared, 1.0))
