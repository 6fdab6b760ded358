"""SIFT features: blobs of a Gaussian scale space, orientations and descriptors of 128 numbers, in JAX.

OpenCV's SIFT (`features.opencv.detect` with ``SIFT()``) is several times as fast on a CPU; this one runs on
accelerators and in batches, and is differentiable: positions and scales by the interpolated extrema, descriptors by the
image.
"""

import math

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxloc._jit import filter_jit
from jaxloc.features.keypoints import Descriptors, Keypoints
from jaxloc.features.scale_space.extrema import ExtremumTest, find_extrema
from jaxloc.features.scale_space.gaussian import Octave, ScaleSpace, octaves
from jaxloc.features.scale_space.orientation import normalize_rows
from jaxloc.features.scale_space.sampling import (
    KeypointLayer,
    LayerSamples,
    concatenate_layers,
    interpolate_layer,
    nearest_layer,
    oriented_grid,
)

_BINS = 36
# Radius of the orientation's neighborhood and width of a descriptor's cell, in blurs of the keypoint.
_WINDOW, _CELL = 4.5, 3.0
# Samples and cells along a side of the descriptor, number of directions; bound on the numbers of a descriptor.
_SAMPLES, _CELLS, _DIRECTIONS = 16, 4, 8
_CLIP = 0.2


class Sift(eqx.Module):
    """Options of SIFT.

    Attributes:
        scales: the scale space.
        least_contrast: threshold of the response times the layers of an octave, as a fraction of 255 gray levels.
        edge_ratio: greatest ratio of principal curvatures.
        orientations: greatest number of orientations of a keypoint; each fills a slot of its own.
        second_peak: least height of a further peak of the orientation histogram, relative to the highest.

    References:
        Lowe, "Distinctive image features from scale-invariant keypoints", IJCV 2004.
    """

    scales: ScaleSpace = ScaleSpace()
    least_contrast: float = eqx.field(static=True, default=0.04)
    edge_ratio: float = eqx.field(static=True, default=10.0)
    orientations: int = eqx.field(static=True, default=2)
    second_peak: float = eqx.field(static=True, default=0.8)


@filter_jit
def sift(image: Float[Array, "h w"], *, options: Sift = Sift(), capacity: int = 1000) -> tuple[Keypoints, Descriptors]:
    """SIFT keypoints with scale and orientation, and their descriptors.

    Args:
        image: gray levels 0-255.
        options: scale space and thresholds.
        capacity: greatest number of blobs, the strongest first; there are ``options.orientations`` slots for each.

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
    gradients = _gradients(stacks)
    uv, sigma, value, valid = _strongest(stacks, options, capacity)
    angles, peaks = _orientations(gradients, uv, sigma, options)
    # The first orientation of all, then the second of all.
    several = options.orientations
    uv, sigma, value = jnp.tile(uv, (several, 1)), jnp.tile(sigma, several), jnp.tile(value, several)
    valid = (jnp.tile(valid, (several, 1)) & peaks.T).reshape(-1)
    angle = jnp.where(valid, angles.T.reshape(-1), 0.0)
    none = jnp.zeros(valid.shape, jnp.int32)
    uv, size = jnp.where(valid[:, None], uv, 0.0), jnp.where(valid, 2.0 * sigma, 0.0)
    keypoints = Keypoints(uv, size, angle, jnp.where(valid, value, 0.0), none, none, valid, "sift")
    return keypoints, _describe(gradients, keypoints, options.scales)


@filter_jit
def describe_sift(
    image: Float[Array, "h w"], keypoints: Keypoints, *, scales: ScaleSpace = ScaleSpace()
) -> Descriptors:
    """SIFT descriptors of given keypoints with size and orientation.

    Gradients on a grid of 16 x 16 samples, rotated and scaled with the keypoint, form histograms of 8 directions in
    4 x 4 cells, with trilinear interpolation between bins and a Gaussian window.

    Args:
        image: gray levels.
        keypoints: ``size`` is twice the blur of the layer that is sampled.
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
    return _describe(_gradients(octaves(image, scales)), keypoints, scales)


def _strongest(stacks: tuple[Octave, ...], options: Sift, capacity: int) -> tuple[Array, Array, Array, Array]:
    """Positions, blurs, responses and validity of the strongest extrema of all octaves."""
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


def _gradients(stacks: tuple[Octave, ...]) -> LayerSamples:
    """Central differences of all layers along rows and columns, gray levels a pixel of the octave."""
    channels = []
    for octave in stacks:
        wide = jnp.pad(octave.layers, ((0, 0), (1, 1), (1, 1)), mode="edge")
        right = 0.5 * (wide[:, 1:-1, 2:] - wide[:, 1:-1, :-2])
        channels.append((right, 0.5 * (wide[:, 2:, 1:-1] - wide[:, :-2, 1:-1])))
    return concatenate_layers(channels, [octave.step for octave in stacks])


def _layer(gradients: LayerSamples, uv: Array, sigma: Array, scales: ScaleSpace) -> KeypointLayer:
    return nearest_layer(gradients, uv, sigma, first_sigma=scales.sigma, per_octave=scales.octave_layers)


def _orientations(gradients: LayerSamples, uv: Array, sigma: Array, options: Sift) -> tuple[Array, Bool[Array, "n k"]]:
    """Directions of the highest peaks of the histogram of gradient directions, and which are high enough.

    References:
        Lowe 2004, section 5 [T-33, T-34].
    """
    layer = _layer(gradients, uv, sigma, options.scales)
    reach = math.ceil(_WINDOW * options.scales.sigma * 2.0 ** (1.0 + 0.5 / options.scales.octave_layers))
    side = jnp.arange(-reach, reach + 1, dtype=jnp.int32)
    middle = jnp.round(lax.stop_gradient(layer.uv)).astype(jnp.int32)
    column, row = middle[:, 0, None] + side[None, :], middle[:, 1, None] + side[None, :]
    height, width = layer.shape[:, 0, None], layer.shape[:, 1, None]
    inside = ((row > 0) & (row < height - 1))[:, :, None] & ((column > 0) & (column < width - 1))[:, None, :]
    flat = (jnp.clip(row, 0, height - 1) * width)[:, :, None] + jnp.clip(column, 0, width - 1)[:, None, :]
    flat = flat + layer.start[:, None, None]
    offset = (side.astype(sigma.dtype) / (_WINDOW / 3.0))[None, :] / layer.sigma[:, None]
    near = jnp.abs(side)[None, :] <= jnp.round(_WINDOW * lax.stop_gradient(layer.sigma)).astype(jnp.int32)[:, None]
    window = jnp.where(near, jnp.exp(-0.5 * offset**2), 0.0)
    weight = jnp.where(inside, window[:, :, None] * window[:, None, :], 0.0).reshape(len(uv), -1)
    flat = flat.reshape(len(uv), -1)
    values = gradients.values[flat]
    magnitude, angle = _polar(values[:, :, 0], values[:, :, 1])
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
    """Highest local maxima, refined by a parabola through three bins [T-34]."""
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


def _describe(gradients: LayerSamples, keypoints: Keypoints, scales: ScaleSpace) -> Descriptors:
    sigma = jnp.where(keypoints.valid, 0.5 * keypoints.size, 1.0)
    layer = _layer(gradients, keypoints.uv, sigma, scales)
    grid = (jnp.arange(_SAMPLES, dtype=sigma.dtype) + 0.5) * (_CELLS / _SAMPLES) - 0.5 * _CELLS
    down, right = (axis.reshape(-1) for axis in jnp.meshgrid(grid, grid, indexing="ij"))
    places = oriented_grid(layer.uv, keypoints.angle, _CELL * layer.sigma, right, down)
    values, inside = interpolate_layer(gradients, layer, *places)
    magnitude, angle = _polar(values[:, :, 0], values[:, :, 1])
    # The Gaussian window is as wide as half the descriptor.
    window = jnp.exp(-(right**2 + down**2) / (2.0 * (0.5 * _CELLS) ** 2))
    weight = jnp.where(inside, magnitude * window[None, :], 0.0)
    # Counter-clockwise in the image, as in OpenCV: descriptors of both can be matched.
    turn = (keypoints.angle[:, None] - angle) * (_DIRECTIONS / (2.0 * math.pi))
    cells = _cells(grid)
    parts = []
    for direction in range(_DIRECTIONS):
        apart = jnp.abs((turn - direction + 0.5 * _DIRECTIONS) % _DIRECTIONS - 0.5 * _DIRECTIONS)
        parts.append((weight * jnp.maximum(1.0 - apart, 0.0)) @ cells)
    values = normalize_rows(jnp.minimum(normalize_rows(jnp.stack(parts, axis=2).reshape(len(sigma), -1)), _CLIP))
    valid = keypoints.valid & (jnp.sum(weight, axis=1) > 0)
    return Descriptors(jnp.where(valid[:, None], values, 0.0), valid)


def _cells(grid: Float[Array, " s"]) -> Float[Array, "s2 c2"]:
    """Bilinear weights of each sample in the cells."""
    centers = jnp.arange(_CELLS, dtype=grid.dtype) + (0.5 - 0.5 * _CELLS)
    share = jnp.maximum(1.0 - jnp.abs(grid[:, None] - centers[None, :]), 0.0)
    return (share[:, None, :, None] * share[None, :, None, :]).reshape(len(grid) ** 2, -1)
