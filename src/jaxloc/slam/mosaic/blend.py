"""Blending of registered images into a mosaic, with exposure compensation."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxloc._jit import filter_jit
from jaxloc.images.interpolation import Bicubic, Bilinear, sample_components
from jaxloc.poses import SE2
from jaxloc.slam.mosaic.raster import Raster
from jaxloc.slam.mosaic.register import Overlap
from jaxloc.slam.mosaic.view import Patch
from jaxloc.solvers.cholesky import factor


class Exposure(eqx.Module):
    """Exposure of an image relative to the mosaic: ``image = gain floor + bias``; one, or a stack.

    Attributes:
        gain: contrast.
        bias: gray levels.
    """

    gain: Float[Array, "*n"]
    bias: Float[Array, "*n"]

    @staticmethod
    def none(count: int, dtype: Any = float) -> "Exposure":
        """Identity exposures."""
        return Exposure(jnp.ones(count, dtype), jnp.zeros(count, dtype))


@filter_jit
def balance(
    first: Int[Array, " m"], second: Int[Array, " m"], overlaps: Overlap, valid: Bool[Array, " m"], *, count: int
) -> Exposure:
    """Estimates the exposures of all images from overlapping pairs.

    Gains by least squares of ``log(s_i / s_j) = log g_i - log g_j`` for the standard deviations s in the overlap, then
    biases likewise from the means; their mean over all images is fixed. Pairs count by their overlap.

    Args:
        first: number of one image of each pair.
        second: number of the other.
        overlaps: of the pairs, stacked.
        valid: which pairs count.
        count: number of images; static.

    Returns:
        The exposures, stacked; those of an image without pairs leave it as it is.

    References:
        [K-84]; Brown and Lowe, "Automatic panoramic image stitching", 2007, section 6 (gain compensation).

    Example:
        >>> import jax.numpy as jnp
        >>> overlap = Overlap(jnp.ones(1), jnp.array([[80.0, 40.0]]), jnp.array([[20.0, 10.0]]))
        >>> found = balance(jnp.array([0]), jnp.array([1]), overlap, jnp.array([True]), count=2)
        >>> [round(float(gain), 2) for gain in found.gain], bool(jnp.all(jnp.abs(found.bias) < 0.01))
        ([1.41, 0.71], True)
    """
    textured = valid & jnp.all(overlaps.deviations > 1e-3, axis=1)
    weight = jnp.where(textured, overlaps.share, 0.0)
    log_contrast = jnp.log(jnp.where(textured[:, None], overlaps.deviations, 1.0))
    log_gain = _potentials(first, second, log_contrast[:, 0] - log_contrast[:, 1], weight, count)
    gain = jnp.exp(log_gain)
    means = jnp.where(textured[:, None], overlaps.means, 0.0)
    level = _potentials(first, second, means[:, 0] / gain[first] - means[:, 1] / gain[second], weight, count)
    return Exposure(gain, gain * level)


def _potentials(first: Array, second: Array, difference: Array, weight: Array, count: int) -> Float[Array, " n"]:
    """Values of nodes, zero in the mean, whose differences over edges are given."""
    matrix = jnp.zeros((count, count), difference.dtype)
    matrix = matrix.at[first, first].add(weight).at[second, second].add(weight)
    matrix = matrix.at[first, second].add(-weight).at[second, first].add(-weight)
    vector = jnp.zeros(count, difference.dtype).at[first].add(weight * difference).at[second].add(-weight * difference)
    # The sum of all is free: a little weight on each value fixes it.
    return factor(matrix + 1e-4 * jnp.eye(count, dtype=matrix.dtype)).solve(vector)


def enclose(poses: SE2, patch: Raster, *, margin: float = 0.0) -> Raster:
    """Smallest axis-aligned raster that contains patches at given poses (host only: its size is a shape).

    Args:
        poses: stacked.
        patch: raster of each.
        margin: beyond them, m.

    Returns:
        The raster, of the patches' resolution.

    Example:
        >>> import jax, jax.numpy as jnp, jaxloc as jl
        >>> poses = jax.vmap(jl.poses.SE2)(jnp.array([0.0, 1.0]), jnp.zeros(2), jnp.zeros(2))
        >>> enclose(poses, Raster(jnp.zeros(2), 0.5, (3, 3))).shape
        (3, 5)
    """
    corners = np.asarray(jax.vmap(lambda pose: pose.apply(patch.corners()))(poses)).reshape(-1, 2)
    low, high = corners.min(axis=0) - margin, corners.max(axis=0) + margin
    resolution = float(patch.resolution)
    columns, rows = (int(np.ceil((b - a) / resolution - 1e-3)) + 1 for a, b in zip(low, high, strict=True))
    return Raster(jnp.asarray(low, patch.origin.dtype), patch.resolution, (rows, columns))


@filter_jit
def blend(
    patches: Patch,
    poses: SE2,
    raster: Raster,
    *,
    exposures: Exposure | None = None,
    used: Bool[Array, " n"] | None = None,
) -> Patch:
    """Weighted blending of patches: ``sum_k w_k (I_k - b_k) / g_k / sum_k w_k``.

    The weight is the vignetting's, so that the bright middles of images make the mosaic and no seam shows.

    Args:
        patches: of equal rasters, values and weights stacked along a leading axis.
        poses: of their frames on the floor, stacked.
        raster: of the mosaic, of the same resolution.
        exposures: stacked; none by default.
        used: which patches count; all by default.

    Returns:
        The mosaic; its weight is the sum of the patches'.

    References:
        [K-83, K-84].

    Example:
        >>> import jax, jax.numpy as jnp, jaxloc as jl
        >>> grid = Raster(jnp.zeros(2), 1.0, (4, 4))
        >>> patches = Patch(jnp.stack([jnp.full((4, 4), 10.0), jnp.full((4, 4), 20.0)]), jnp.ones((2, 4, 4)), grid)
        >>> poses = jax.vmap(jl.poses.SE2)(jnp.array([0.0, 2.0]), jnp.zeros(2), jnp.zeros(2))
        >>> blend(patches, poses, enclose(poses, grid)).values[1].round(2).tolist()
        [10.0, 10.0, 15.0, 15.0, 20.0, 20.0]
    """
    count, dtype = patches.values.shape[0], patches.values.dtype
    exposures = Exposure.none(count, dtype) if exposures is None else exposures
    used = jnp.ones(count, bool) if used is None else used
    side = int(np.ceil(np.hypot(*patches.raster.shape))) + 3
    window = tuple(min(side, length) for length in raster.shape)

    def add(sums: Array, frame: Any) -> tuple[Array, None]:
        values, weight, pose, exposure, use = frame
        rows, columns = corner_of_window(pose, patches.raster, raster, window)
        even = (values - exposure.bias) / jnp.maximum(exposure.gain, 1e-3)
        light, worth = _laid(Patch(even, weight, patches.raster), pose, raster, (rows, columns), window)
        worth = jnp.where(use, worth, 0.0)
        place = (jnp.zeros_like(rows), rows, columns)
        before = lax.dynamic_slice(sums, place, (2, *window))
        return lax.dynamic_update_slice(sums, before + jnp.stack([worth * light, worth]), place), None

    frames = (patches.values, patches.weight, poses, exposures, used)
    (total, weight), _ = lax.scan(add, jnp.zeros((2, *raster.shape), dtype), frames)
    known = weight > 1e-4
    return Patch(jnp.where(known, total / jnp.where(known, weight, 1.0), 0.0), jnp.where(known, weight, 0.0), raster)


def corner_of_window(pose: SE2, patch: Raster, raster: Raster, window: tuple[int, int]) -> tuple[Array, Array]:
    """First row and column of the window about a patch, kept on the mosaic."""
    middle = raster.to_pixels(pose.apply(jnp.mean(patch.corners(), axis=0)[None]))[0]
    middle = jnp.where(jnp.isfinite(middle), middle, 0.0)
    starts = []
    for axis, length, edge in ((middle[1], raster.shape[0], window[0]), (middle[0], raster.shape[1], window[1])):
        starts.append(jnp.clip(jnp.round(axis) - edge // 2, 0, length - edge).astype(jnp.int32))
    return starts[0], starts[1]


def _laid(
    patch: Patch, pose: SE2, raster: Raster, corner: tuple[Array, Array], window: tuple[int, int]
) -> tuple[Float[Array, "a b"], Float[Array, "a b"]]:
    """Values and weights of a patch on a window of the mosaic."""
    dtype = patch.values.dtype
    u = corner[1].astype(dtype) + jnp.arange(window[1], dtype=dtype)
    v = corner[0].astype(dtype) + jnp.arange(window[0], dtype=dtype)
    u, v = (axis.reshape(-1) for axis in jnp.meshgrid(u, v))
    right, down = raster.warp(pose, patch.raster).inverse().map_components(u, v)
    values, inside = sample_components(patch.values, right, down, method=Bicubic())
    # Where a weight is left after the holes have grown, no tap of the cubic kernel touches one.
    worth, _ = sample_components(_eroded(patch.weight), right, down, method=Bilinear())
    whole = inside & (worth > 0)
    return jnp.where(whole, values, 0.0).reshape(window), jnp.where(whole, worth, 0.0).reshape(window)


def _eroded(weight: Float[Array, "p q"]) -> Float[Array, "p q"]:
    """The weight where no pixel within two rows and columns lacks one."""
    for axis in (0, 1):
        padded = jnp.pad(weight, [(2, 2) if axis == a else (0, 0) for a in (0, 1)], constant_values=1.0)
        parts = [lax.slice_in_dim(padded, k, k + weight.shape[axis], axis=axis) for k in range(5)]
        hole = sum(((part <= 0).astype(weight.dtype) for part in parts), start=jnp.zeros_like(weight)) > 0
        weight = jnp.where(hole, 0.0, weight)
    return weight
