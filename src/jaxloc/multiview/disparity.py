"""Dense stereo matching of a rectified pair: block matching in JAX, semi-global matching by OpenCV, refinement."""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Num

from jaxloc._arguments import checked
from jaxloc._jit import filter_jit
from jaxloc.features import subpixel
from jaxloc.features.opencv import backend

# Cost of windows outside the other image.
_OUTSIDE = 1e9


class DisparityMap(eqx.Module):
    """Disparities ``u_left - u_right`` of the pixels of the left image.

    Attributes:
        disparity: px; zero where not valid.
        variance: px^2; one where not valid. It accounts for pixel noise, not for wrong matches; that of block matching
            is right within a factor of three, that of `refine` is more accurate.
        valid: pixels with a disparity.
    """

    disparity: Float[Array, "h w"]
    variance: Float[Array, "h w"]
    valid: Bool[Array, "h w"]


class WindowCost(eqx.Module):
    """Matching cost of two windows."""

    @abstractmethod
    def prepare(self, image: Float[Array, "h w"], size: int) -> Any:
        """Arrays "... h w" that are computed once an image."""

    @abstractmethod
    def compare(self, left: Any, right: Any, size: int) -> Float[Array, "h w"]:
        """Cost of the windows around each pixel of two prepared images."""


class SSD(WindowCost):
    """Mean squared difference of gray levels [R-44]."""

    @checked
    def prepare(self, image: Float[Array, "h w"], size: int) -> Any:
        """The image."""
        del size
        return image

    def compare(self, left: Any, right: Any, size: int) -> Float[Array, "h w"]:
        """Mean over the window."""
        return box_mean((left - right) ** 2, size)


class ZNCC(WindowCost):
    """One minus the zero-mean normalized correlation: invariant to gain and bias of a window [R-44].

    Attributes:
        least_contrast: standard deviation below which a window has no texture, gray levels.
    """

    least_contrast: float = eqx.field(static=True, default=1.0)

    @checked
    def prepare(self, image: Float[Array, "h w"], size: int) -> Any:
        """The centered image, with mean and inverse standard deviation of each window."""
        centered = image - jnp.mean(image)
        mean = box_mean(centered, size)
        variance = box_mean(centered**2, size) - mean**2
        textured = variance > self.least_contrast**2
        return jnp.stack([centered, mean, jnp.where(textured, lax.rsqrt(jnp.where(textured, variance, 1.0)), 0.0)])

    def compare(self, left: Any, right: Any, size: int) -> Float[Array, "h w"]:
        """Between 0 and 2."""
        product = box_mean(left[0] * right[0], size) - left[1] * right[1]
        return 1.0 - product * left[2] * right[2]


class Census(WindowCost):
    """Census transform: Hamming distance of comparisons with the center pixel; without derivatives.

    Attributes:
        radius: half sides (rows, columns) of the compared neighborhood.

    References:
        Zabih and Woodfill, "Non-parametric local transforms for computing visual correspondence", ECCV 1994.
    """

    radius: tuple[int, int] = eqx.field(static=True, default=(3, 4))

    @checked
    def prepare(self, image: Float[Array, "h w"], size: int) -> Any:
        """Comparisons of the neighbors with the center pixel, 31 bits an integer."""
        del size
        rows, columns = self.radius
        height, width = image.shape
        padded = jnp.pad(image, ((rows, rows), (columns, columns)), mode="edge")
        bits = [
            padded[i : i + height, j : j + width] < image
            for i in range(2 * rows + 1)
            for j in range(2 * columns + 1)
            if (i, j) != self.radius
        ]
        groups = [bits[start : start + 31] for start in range(0, len(bits), 31)]
        return jnp.stack([sum(bit.astype(jnp.int32) << k for k, bit in enumerate(group)) for group in groups])

    def compare(self, left: Any, right: Any, size: int) -> Float[Array, "h w"]:
        """Fraction of bits that differ."""
        rows, columns = self.radius
        count = (2 * rows + 1) * (2 * columns + 1) - 1
        differ = jnp.sum(lax.population_count(jnp.bitwise_xor(left, right)), axis=0)
        return box_mean(differ.astype(jnp.float32) / count, size)


@checked
def box_mean(image: Float[Array, "h w"], size: int) -> Float[Array, "h w"]:
    """Mean of the size x size window about each pixel; the edge is repeated outside.

    Example:
        >>> import jax.numpy as jnp
        >>> round(float(box_mean(jnp.eye(3), 3)[1, 1]), 3)
        0.333
    """
    if not image.size:
        return image
    half, (height, width) = size // 2, image.shape
    padded = jnp.pad(image, half, mode="edge")
    rows = sum(padded[i : i + height] for i in range(size))
    return sum(rows[:, j : j + width] for j in range(size)) / size**2


class Matcher(eqx.Module):
    """Matcher of a rectified pair."""

    @abstractmethod
    def match(self, left: Num[Any, "h w"], right: Num[Any, "h w"]) -> DisparityMap:
        """The disparity of each pixel of the left image."""


class BlockMatching(Matcher):
    """Block matching in JAX, for batches, accelerators and derivatives.

    Attributes:
        cost: matching cost.
        size: odd side of a window, px.
        num_disparities: number of disparities, from zero.
        uniqueness: least relative excess of the cost of all other disparities but the two neighbors.
        consistency: greatest difference between left-to-right and right-to-left disparities, px.
    """

    cost: WindowCost = Census()
    size: int = eqx.field(static=True, default=9)
    num_disparities: int = eqx.field(static=True, default=96)
    uniqueness: float = eqx.field(static=True, default=0.05)
    consistency: float = eqx.field(static=True, default=1.0)

    def match(self, left: Num[Any, "h w"], right: Num[Any, "h w"]) -> DisparityMap:
        """Lowest cost, a parabola through its neighbors, and the left-right consistency check."""
        dtype = left.dtype if jnp.issubdtype(left.dtype, jnp.floating) else jnp.float32
        return _match_blocks(jnp.asarray(left, dtype), jnp.asarray(right, dtype), self)


class SemiGlobal(Matcher):
    """OpenCV's semi-global matcher, on the host; fast, quantized to 1/16 px, which `refine` removes.

    Attributes:
        num_disparities: number of disparities, a multiple of 16.
        size: odd side of a window, px.
        uniqueness: margin of the best cost over the second, percent.
        consistency: greatest difference between left and right, px; -1 for none.
        sigma: standard deviation of its disparities, px.

    References:
        Hirschmuller, "Stereo processing by semiglobal matching and mutual information", T-PAMI 2008.
    """

    num_disparities: int = eqx.field(static=True, default=96)
    size: int = eqx.field(static=True, default=5)
    uniqueness: int = eqx.field(static=True, default=10)
    consistency: int = eqx.field(static=True, default=1)
    sigma: float = eqx.field(static=True, default=0.25)

    def match(self, left: Num[Any, "h w"], right: Num[Any, "h w"]) -> DisparityMap:
        """Runs OpenCV on 8-bit gray levels.

        Raises:
            ImportError: OpenCV is not installed.
        """
        penalty = self.size**2
        matcher = backend.load().StereoSGBM_create(
            minDisparity=0,
            numDisparities=self.num_disparities,
            blockSize=self.size,
            P1=8 * penalty,
            P2=32 * penalty,
            disp12MaxDiff=self.consistency,
            uniquenessRatio=self.uniqueness,
            speckleWindowSize=100,
            speckleRange=2,
        )
        found = matcher.compute(backend.to_uint8(left), backend.to_uint8(right)).astype(np.float32) / 16.0
        valid = found > 0
        variance = np.where(valid, self.sigma**2, 1.0).astype(np.float32)
        return DisparityMap(jnp.asarray(np.where(valid, found, 0.0)), jnp.asarray(variance), jnp.asarray(valid))


def match(
    left: Num[Any, "h w"],
    right: Num[Any, "h_right w_right"],
    *,
    matcher: Matcher = SemiGlobal(),  # noqa: B008 (an immutable record)
) -> DisparityMap:
    """Disparity of each pixel of the left image of a rectified pair.

    Args:
        left: left image, gray levels.
        right: right image.
        matcher: `SemiGlobal()` is OpenCV's, on the host; `BlockMatching()` works under `jit`, `vmap` and `grad`.

    Returns:
        Disparities, their variance, and where they are valid.

    Raises:
        ValueError: the images have different shapes.

    References:
        Review section 5.1 [R-44]; thesis section 2.1 [T-7].

    Example:
        >>> import jax, jax.numpy as jnp, jaxloc as jl
        >>> scene = jax.random.uniform(jax.random.key(0), (24, 60), maxval=255.0)
        >>> left, right = scene[:, :50], scene[:, 6:56]
        >>> blocks = jl.multiview.disparity.BlockMatching(jl.multiview.disparity.ZNCC(), num_disparities=12)
        >>> found = jl.multiview.disparity.match(left, right, matcher=blocks)
        >>> bool(found.valid[12, 30]), round(float(found.disparity[12, 30]), 1)
        (True, 6.0)
    """
    if left.shape != right.shape:
        raise ValueError(f"Images of a pair have one shape; these have {left.shape} and {right.shape}.")
    if not left.size:
        raise ValueError(f"Images of a pair have at least one pixel; these have shape {left.shape}.")
    return matcher.match(left, right)


@filter_jit
def _match_blocks(left: Array, right: Array, options: BlockMatching) -> DisparityMap:
    finite = jnp.isfinite(left) & jnp.isfinite(right)
    left, right = (jnp.where(jnp.isfinite(image), image, 0.0) for image in (left, right))
    costs = _cost_volume(left, right, options)
    best = lax.stop_gradient(jnp.argmin(costs, axis=0))
    last = options.num_disparities - 1
    lowest, before, after = (
        jnp.take_along_axis(costs, jnp.clip(best + step, 0, last)[None], axis=0)[0] for step in (0, -1, 1)
    )
    inner = (best > 0) & (best < last) & (before < _OUTSIDE) & (after < _OUTSIDE)
    curvature = jnp.where(inner, before - 2.0 * lowest + after, 0.0)
    curved = curvature > 1e-6
    safe = jnp.where(curved, curvature, 1.0)
    disparity = best.astype(left.dtype) + jnp.where(curved, 0.5 * (before - after) / safe, 0.0)
    valid = inner & curved & _inside(left.shape, options.size)
    valid &= _is_unique(costs, best, lowest, options.uniqueness) & _is_consistent(costs, best, options.consistency)
    valid &= box_mean(finite.astype(left.dtype), options.size) > 0.999
    # The lowest cost is due to noise, its curvature to texture: 2 c / (n c''), as for sums of squares.
    variance = 2.0 * jnp.maximum(lowest, 0.0) / (options.size**2 * safe)
    return DisparityMap(jnp.where(valid, disparity, 0.0), jnp.where(valid, variance, 1.0), valid)


def _cost_volume(left: Array, right: Array, options: BlockMatching) -> Float[Array, "d h w"]:
    prepared = [options.cost.prepare(image, options.size) for image in (left, right)]
    width, span = left.shape[1], options.num_disparities
    column = jnp.arange(width)
    wide = jnp.pad(prepared[1], [(0, 0)] * (prepared[1].ndim - 1) + [(span, 0)])

    def at(disparity: Array) -> Array:
        moved = lax.dynamic_slice_in_dim(wide, span - disparity, width, axis=wide.ndim - 1)
        cost = options.cost.compare(prepared[0], moved, options.size).astype(left.dtype)
        return jnp.where((column >= disparity + options.size // 2)[None, :], cost, _OUTSIDE)

    return lax.map(at, jnp.arange(span))


def _inside(shape: tuple[int, ...], size: int) -> Bool[Array, "h w"]:
    half, (height, width) = size // 2, shape
    row, column = jnp.arange(height), jnp.arange(width)
    rows, columns = (row >= half) & (row < height - half), (column >= half) & (column < width - half)
    return rows[:, None] & columns[None, :]


def _is_unique(costs: Array, best: Array, lowest: Array, margin: float) -> Bool[Array, "h w"]:
    """Whether all disparities but the best and its neighbors cost clearly more."""

    def least_other(d: Any, least: Array) -> Array:
        return jnp.where(jnp.abs(best - d) <= 1, least, jnp.minimum(least, costs[d]))

    rest = lax.stop_gradient(lax.fori_loop(0, costs.shape[0], least_other, jnp.full_like(lowest, _OUTSIDE)))
    return rest > (1.0 + margin) * lowest


def _is_consistent(costs: Array, best: Array, tolerance: float) -> Bool[Array, "h w"]:
    """Left-right consistency: whether the right image's pixel is matched to the same disparity."""
    span, height, width = costs.shape

    def from_right(d: Any, state: tuple[Array, Array]) -> tuple[Array, Array]:
        least, chosen = state
        padded = jnp.pad(costs[d], ((0, 0), (0, span)), constant_values=_OUTSIDE)
        cost = lax.dynamic_slice_in_dim(padded, d, width, axis=1)
        return jnp.minimum(cost, least), jnp.where(cost < least, d, chosen)

    initial = jnp.full((height, width), 2.0 * _OUTSIDE, costs.dtype), jnp.zeros((height, width), best.dtype)
    _, chosen = lax.stop_gradient(lax.fori_loop(0, span, from_right, initial))
    partner = jnp.clip(jnp.arange(width)[None, :] - best, 0, width - 1)
    difference = jnp.abs(jnp.take_along_axis(chosen, partner, axis=1) - best)
    return difference.astype(costs.dtype) <= tolerance


class DenseRefinement(eqx.Module):
    """Options of the refinement of disparities.

    Attributes:
        patches: window, reach and thresholds.
        most: greatest accepted correction, px; larger ones belong to another surface.
    """

    patches: subpixel.PatchRefinement = subpixel.PatchRefinement(size=7, reach=1, num_steps=3, min_correlation=0.7)
    most: float = eqx.field(static=True, default=0.5)


@filter_jit
@checked
def refine(
    left: Float[Array, "h w"],
    right: Float[Array, "h w"],
    found: DisparityMap,
    *,
    options: DenseRefinement = DenseRefinement(),  # noqa: B008 (an immutable record)
) -> DisparityMap:
    """Subpixel refinement of disparities, with gain and bias of every window.

    Args:
        left: left image, gray levels.
        right: right image.
        found: disparities within a pixel of the truth.
        options: window, thresholds and greatest correction.

    Returns:
        The map with refined disparities and their variance where the refinement is valid, and unchanged values
        elsewhere. Gradients are those of the minimum.

    References:
        `features.subpixel.refine_stereo` [T-10].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> u, v = jnp.meshgrid(jnp.arange(60.0), jnp.arange(20.0))
        >>> scene = lambda u: 100 + 50 * jnp.sin(0.5 * u) * jnp.cos(0.4 * v)
        >>> whole = jnp.full((20, 60), 4.0)
        >>> rough = jl.multiview.disparity.DisparityMap(whole, jnp.ones_like(whole), whole > 0)
        >>> found = jl.multiview.disparity.refine(scene(u), 0.8 * scene(u + 4.3) + 9, rough)
        >>> round(float(found.disparity[10, 30]), 1)
        4.3
    """
    left, right = (jnp.where(jnp.isfinite(image), image, 0.0) for image in (left, right))
    height, width = left.shape
    columns = jnp.arange(width, dtype=left.dtype)
    disparity = found.disparity.astype(left.dtype)

    def row(item: tuple[Array, Array]) -> subpixel.RefinedPoints:
        index, shifts = item
        rows = jnp.full_like(columns, index)
        uv_left, uv_right = jnp.stack([columns, rows], axis=1), jnp.stack([columns - shifts, rows], axis=1)
        return subpixel.refine_stereo(left, right, uv_left, uv_right, options=options.patches)

    refined = lax.map(row, (jnp.arange(height, dtype=left.dtype), disparity))
    moved = columns[None, :] - refined.uv[:, :, 0]
    better = found.valid & refined.ok & (jnp.abs(moved - disparity) <= options.most)
    variance = jnp.where(better, refined.variance, found.variance.astype(left.dtype))
    return DisparityMap(jnp.where(better, moved, disparity), variance, found.valid)
