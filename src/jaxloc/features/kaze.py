"""KAZE features: blobs of a nonlinear scale space and M-SURF descriptors, in JAX; the base of A-KAZE.

References:
    Alcantarilla, Bartoli, Davison, "KAZE features", ECCV 2012.
"""

from abc import abstractmethod

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxloc._jit import filter_jit
from jaxloc.features.keypoints import Descriptors, Keypoints
from jaxloc.features.scale_space.extrema import ExtremumTest, find_extrema
from jaxloc.features.scale_space.nonlinear import NonlinearScaleSpace, Stack, nonlinear_scale_space
from jaxloc.features.scale_space.orientation import disc_offsets, dominant_direction, normalize_rows, rotate_gradients
from jaxloc.features.scale_space.sampling import (
    LayerSamples,
    concatenate_layers,
    interpolate_layer,
    nearest_layer,
    oriented_grid,
)

# Orientation: radius of the neighborhood and standard deviation of its Gaussian weights, in samples.
_RADIUS, _SIGMA = 6, 2.5
# M-SURF: cells along a side, samples along a cell and between two cells; deviations of the Gaussians (samples, cells).
_CELLS, _CELL, _SHIFT, _CELL_SIGMA, _GRID_SIGMA = 4, 9, 5, 2.5, 1.5
# Candidates for each slot: many lie on ridges, where the vertex of the quadratic model is far away, or are suppressed.
_SURPLUS = 4
# Keypoints suppress weaker ones whose size differs by less than this ratio.
_SIZE_RATIO = 1.35


class AbstractDescriptor(eqx.Module):
    """Descriptor computed from the samples around a keypoint."""

    side: eqx.AbstractClassVar[int]

    @abstractmethod
    def describe(self, values: Float[Array, "n k 3"], inside: Bool[Array, "n k"], angle: Float[Array, " n"]) -> Array:
        """Descriptors from a sampling grid of ``side x side``, rotated with the keypoint.

        Args:
            values: gray level, derivative along rows and along columns of the image.
            inside: which samples lie inside of the image.
            angle: of the keypoint, rad.
        """


class MSurf(AbstractDescriptor):
    """M-SURF descriptor: sums of derivatives and of their absolute values in 4 x 4 overlapping cells, 64 numbers.

    Gaussian weights about the center of each cell and about the keypoint; normalized to length one.

    References:
        Agrawal, Konolige, Blas, "CenSurE", ECCV 2008; Alcantarilla et al., ECCV 2012, section 3.2.
    """

    side = _SHIFT * (_CELLS - 1) + _CELL

    def describe(self, values: Float[Array, "n k 3"], inside: Bool[Array, "n k"], angle: Float[Array, " n"]) -> Array:
        """Descriptors "n 64" of length one."""
        derivatives = jnp.where(inside[:, :, None], values[:, :, 1:], 0.0)
        along, across = rotate_gradients(derivatives[:, :, 0], derivatives[:, :, 1], angle)
        cells = jnp.asarray(self.cell_weights(), values.dtype)
        sums = [part @ cells for part in (along, across, jnp.abs(along), jnp.abs(across))]
        return normalize_rows(jnp.stack(sums, axis=2).reshape(len(angle), -1))

    def cell_weights(self) -> np.ndarray:
        """Weights of all samples in the sums of all cells.

        Example:
            >>> MSurf().cell_weights().shape
            (576, 16)
        """
        sample, cell = np.arange(self.side)[:, None], np.arange(_CELLS)[None, :]
        offset = sample - (_SHIFT * cell + 0.5 * (_CELL - 1))
        share = np.where(2 * np.abs(offset) < _CELL, np.exp(-0.5 * (offset / _CELL_SIGMA) ** 2), 0.0)
        share = share * np.exp(-0.5 * ((cell - 0.5 * (_CELLS - 1)) / _GRID_SIGMA) ** 2)
        return np.kron(share, share)


class Kaze(eqx.Module):
    """Options of KAZE; `akaze_options` makes those of A-KAZE.

    Attributes:
        scales: the nonlinear scale space.
        descriptor: `MSurf` or `MLdb`.
        within_layer: keypoints are maxima of their own layer, suppressed by stronger ones nearby in adjacent layers
            (A-KAZE); else maxima over position and scale (KAZE).
        least_response: threshold of the determinant, as a fraction of 255^2.
        upright: orientation zero for all keypoints: for cameras that do not roll.
    """

    scales: NonlinearScaleSpace = NonlinearScaleSpace()
    descriptor: AbstractDescriptor = MSurf()
    within_layer: bool = eqx.field(static=True, default=False)
    least_response: float = eqx.field(static=True, default=1e-3)
    upright: bool = eqx.field(static=True, default=False)


@filter_jit
def kaze(image: Float[Array, "h w"], *, options: Kaze = Kaze(), capacity: int = 1000) -> tuple[Keypoints, Descriptors]:
    """KAZE keypoints with scale and orientation, and their descriptors.

    Maxima of the determinant of the Hessian, refined by a quadratic model; a stronger one of about the same size within
    the reach of the derivatives suppresses a weaker one. The orientation is the dominant direction of the derivatives
    in a window of 60 degrees.

    Args:
        image: gray levels 0-255.
        options: scale space, descriptor and thresholds.
        capacity: greatest number of keypoints, the strongest first.

    Returns:
        Keypoints and their descriptors. ``size`` is twice the reach, as in OpenCV: 2 blurs for KAZE, 3 for A-KAZE.

    References:
        Alcantarilla et al. 2012 [T-43, T-48].

    Example:
        >>> import jax.numpy as jnp
        >>> u, v = jnp.meshgrid(jnp.arange(64.0), jnp.arange(64.0))
        >>> image = 60 + 120 * jnp.exp(-((u - 30.3) ** 2 + 1.3 * (v - 33.6) ** 2) / 18)
        >>> keypoints, descriptors = kaze(image, capacity=4)
        >>> [round(float(x)) for x in keypoints.uv[0]], descriptors.values.shape
        ([30, 34], (4, 64))
    """
    stacks = nonlinear_scale_space(image, options.scales)
    samples = _samples(stacks)
    keypoints = _strongest(stacks, options, capacity)
    if not options.upright:
        keypoints = eqx.tree_at(lambda k: k.angle, keypoints, _orientations(samples, keypoints, options.scales))
    return keypoints, _describe(samples, keypoints, options)


@filter_jit
def describe_kaze(image: Float[Array, "h w"], keypoints: Keypoints, *, options: Kaze = Kaze()) -> Descriptors:
    """KAZE descriptors of given keypoints with size and orientation.

    Args:
        image: gray levels 0-255.
        keypoints: ``size`` is twice the reach of the derivatives.
        options: scale space and descriptor.

    Returns:
        64 numbers of length one (`MSurf`) or 61 bytes (`MLdb`) a keypoint; zero where not valid.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> image = jax.random.uniform(jax.random.key(0), (64, 64), maxval=255.0)
        >>> points = Keypoints.from_uv(jnp.array([[30.0, 30.0]]), size=6.0)
        >>> describe_kaze(image, points).values.shape
        (1, 64)
    """
    return _describe(_samples(nonlinear_scale_space(image, options.scales)), keypoints, options)


def _samples(stacks: tuple[Stack, ...]) -> LayerSamples:
    """Gray levels and both derivatives of all layers."""
    return concatenate_layers([(s.layers, s.right, s.down) for s in stacks], [s.step for s in stacks])


def _strongest(stacks: tuple[Stack, ...], options: Kaze, capacity: int) -> Keypoints:
    """The strongest maxima of the determinants of all stacks."""
    scales, shape, parts = options.scales, stacks[0].layers.shape[1:], []
    # A ridge of the determinant is no edge of the image: no test of the ratio of curvatures.
    least = 255.0**2 * options.least_response
    test = ExtremumTest(least, edge_ratio=1e6, minima=False, within_layer=options.within_layer)
    for stack in stacks:
        blobs = find_extrema(stack.determinant, test, capacity=_SURPLUS * capacity)
        sigma = scales.sigma * stack.step * jnp.exp2(blobs.place[:, 0] / scales.layers)
        uv = stack.step * blobs.place[:, :0:-1]
        # The second derivatives must lie within the image: large blobs at the border are seldom detected again.
        last = jnp.asarray([shape[1] - 1, shape[0] - 1], uv.dtype)[None, :]
        margin = jnp.min(jnp.minimum(uv, last - uv), axis=1)
        parts.append((uv, sigma, blobs.value, blobs.valid & (margin >= 2.0 * scales.reach * sigma)))
    uv, sigma, value, valid = (jnp.concatenate(column) for column in zip(*parts, strict=True))
    _, best = lax.top_k(lax.stop_gradient(jnp.where(valid, value, -1.0)), min(_SURPLUS * capacity, value.shape[0]))
    uv, sigma, value, valid = uv[best], sigma[best], value[best], valid[best]
    valid = valid & ~_is_suppressed(*lax.stop_gradient((uv, sigma)), valid, scales.reach)
    kept = jnp.argsort(~valid, stable=True)[:capacity]
    uv, sigma, value, valid = uv[kept], sigma[kept], value[kept], valid[kept]
    size, none = jnp.where(valid, 2.0 * scales.reach * sigma, 0.0), jnp.zeros(valid.shape, jnp.int32)
    return Keypoints(uv, size, jnp.zeros_like(size), value, none, none, valid, "kaze")


def _is_suppressed(uv: Array, sigma: Array, valid: Array, reach: float) -> Bool[Array, " n"]:
    """Whether an earlier keypoint of similar size lies within reach: large blobs have several maxima."""
    squared = sum((uv[:, None, k] - uv[None, :, k]) ** 2 for k in (0, 1))
    ratio = sigma[:, None] / sigma[None, :]
    similar = (ratio < _SIZE_RATIO) & (ratio > 1.0 / _SIZE_RATIO)
    index = jnp.arange(valid.shape[0])
    near = squared < (reach * sigma[:, None]) ** 2
    return jnp.any(near & similar & valid[None, :] & (index[None, :] < index[:, None]), axis=1)


def _sample_grid(samples: LayerSamples, keypoints: Keypoints, scales: NonlinearScaleSpace, grid: tuple, angle: Array):
    """Values and validity of samples on a grid (right, down) around each keypoint, rotated by an angle."""
    sigma = jnp.where(keypoints.valid, keypoints.size / (2.0 * scales.reach), scales.sigma)
    layer = nearest_layer(samples, keypoints.uv, sigma, first_sigma=scales.sigma, per_octave=scales.layers)
    return interpolate_layer(samples, layer, *oriented_grid(layer.uv, angle, scales.reach * layer.sigma, *grid))


def _orientations(samples: LayerSamples, keypoints: Keypoints, scales: NonlinearScaleSpace) -> Float[Array, " n"]:
    columns, rows = (np.array(side) for side in disc_offsets(_RADIUS))
    values, inside = _sample_grid(samples, keypoints, scales, (columns, rows), jnp.zeros_like(keypoints.size))
    weight = jnp.asarray(np.exp(-0.5 * (columns**2 + rows**2) / _SIGMA**2), values.dtype)[None, :]
    weight = jnp.where(inside, weight, 0.0)
    direction = dominant_direction(weight * values[:, :, 1], weight * values[:, :, 2])
    return jnp.where(keypoints.valid & direction.ok, direction.angle, 0.0)


def _describe(samples: LayerSamples, keypoints: Keypoints, options: Kaze) -> Descriptors:
    side = options.descriptor.side
    offsets = np.arange(side) - 0.5 * (side - 1)
    rows, columns = (axis.reshape(-1) for axis in np.meshgrid(offsets, offsets, indexing="ij"))
    values, inside = _sample_grid(samples, keypoints, options.scales, (columns, rows), keypoints.angle)
    descriptors = options.descriptor.describe(values, inside, keypoints.angle)
    gradients = jnp.sum(jnp.where(inside[:, :, None], jnp.abs(values[:, :, 1:]), 0.0), axis=(1, 2))
    valid = keypoints.valid & (gradients > 0)
    return Descriptors(jnp.where(valid[:, None], descriptors, jnp.zeros((), descriptors.dtype)), valid)
