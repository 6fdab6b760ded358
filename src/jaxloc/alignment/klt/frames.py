"""Image pyramid for tracking, packed into one array, with the distribution of gray levels."""

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, UInt8

from jaxloc import _tree as tree
from jaxloc.images.pyramid import gaussian_pyramid

_SAMPLES = 4096


class Frame(eqx.Module):
    """A preprocessed image, shared by all tracked points.

    Attributes:
        atlas: Every level with repeated border pixels, level 0 on top, all others side by side below it. Gradients pass
            through level 0 only.
        finite: Finite pixels of level 0, its border included.
        all_finite: Whether all of them are.
        quantiles: Sorted sample of gray levels of a coarse level, to compare exposures.
        shape: Rows and columns of the image.
        levels: Number of pyramid levels.
        margin: Width of the repeated border of every level, px.
    """

    atlas: Float[Array, "a b"]
    finite: Bool[Array, "c d"]
    all_finite: Bool[Array, ""]
    quantiles: Float[Array, " s"]
    shape: tuple[int, int] = eqx.field(static=True)
    levels: int = eqx.field(static=True)
    margin: int = eqx.field(static=True)


def build_frame(image: Float[Array, "h w"] | UInt8[Array, "h w"], levels: int, margin: int) -> Frame:
    """Builds and packs the pyramid; non-finite pixels are replaced by the mean of the others.

    Args:
        image: Grayscale image; integers become float32.
        levels: Number of pyramid levels.
        margin: Pixels by which the border of every level is repeated.

    Returns:
        The frame.

    Example:
        >>> import jax.numpy as jnp
        >>> frame = build_frame(jnp.ones((40, 50)), 3, 6)
        >>> frame.atlas.shape, frame.finite.shape
        ((84, 62), (52, 62))
    """
    gray, finite, clean = _replace_nonfinite(image)
    pyramid = (gray, *gaussian_pyramid(lax.stop_gradient(gray), levels=levels)[1:])
    padded = [jnp.pad(level, margin, mode="edge") for level in pyramid]
    atlas = jnp.zeros(_atlas_shape(image.shape, levels, margin), dtype=gray.dtype)
    for level, corner in zip(padded, _corners(image.shape, levels, margin), strict=True):
        atlas = lax.dynamic_update_slice(atlas, level, (corner[1], corner[0]))
    return Frame(atlas, jnp.pad(finite, margin, mode="edge"), clean, _quantiles(pyramid), image.shape, levels, margin)


def _replace_nonfinite(image: Float[Array, "h w"] | UInt8[Array, "h w"]):
    """The image with finite values, the mask of pixels that were finite and in range, and whether all were."""
    if not jnp.issubdtype(image.dtype, jnp.floating):
        return image.astype(jnp.float32), jnp.ones(image.shape, dtype=bool), jnp.array(True)
    greatest = jnp.abs(lax.stop_gradient(image))
    # Products of larger ones overflow in the sums over patches.
    finite = greatest < tree.largest(image.dtype)
    # One reduction, nearly always of an image without such pixels. It bounds the largest; maxima may pass over NaN.
    clean = jnp.sum(greatest * greatest) < tree.largest(image.dtype) ** 2

    def mean_of_finite(_):
        count = jnp.maximum(jnp.sum(finite, dtype=jnp.int32), 1).astype(image.dtype)
        return jnp.sum(jnp.where(finite, image, 0.0)) / count

    mean = lax.cond(clean, lambda _: jnp.zeros((), dtype=image.dtype), mean_of_finite, None)
    return jnp.where(finite, image, lax.stop_gradient(mean)), finite, clean


def level_corners(frame: Frame) -> Int[Array, "l 2"]:
    """Position (column, row) in the atlas of pixel (0, 0) of each level.

    Example:
        >>> import jax.numpy as jnp
        >>> level_corners(build_frame(jnp.ones((40, 50)), 3, 6)).tolist()
        [[6, 6], [6, 58], [43, 58]]
    """
    corners = _corners(frame.shape, frame.levels, frame.margin)
    return jnp.array([[u + frame.margin, v + frame.margin] for u, v in corners], dtype=jnp.int32)


def level_sizes(frame: Frame) -> Int[Array, "l 2"]:
    """Columns and rows of each level.

    Example:
        >>> import jax.numpy as jnp
        >>> level_sizes(build_frame(jnp.ones((40, 50)), 3, 6)).tolist()
        [[50, 40], [25, 20], [13, 10]]
    """
    return jnp.array([shape[::-1] for shape in _shapes(frame.shape, frame.levels)], dtype=jnp.int32)


def relative_gain(previous: Frame, current: Frame) -> Float[Array, ""]:
    """Contrast of one frame relative to another: slope of the regression of sorted gray levels on sorted gray levels.

    The lowest and highest twentieth are ignored, for saturated pixels and new bright objects. No pixels are matched:
    the scene may move.

    Args:
        previous: Reference frame.
        current: Frame of the contrast.

    Returns:
        The gain, between 1/8 and 8; 1 where a frame has no contrast.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> image = 100 + 30 * jax.random.normal(jax.random.key(0), (40, 50))
        >>> first, second = build_frame(image, 3, 6), build_frame(0.6 * image + 30, 3, 6)
        >>> round(float(relative_gain(first, second)), 2)
        0.6
    """
    cut = previous.quantiles.shape[0] // 20
    first, second = (frame.quantiles[cut : frame.quantiles.shape[0] - cut] for frame in (previous, current))
    first, second = first - jnp.mean(first), second - jnp.mean(second)
    below, above = jnp.sum(first * first), jnp.sum(first * second)
    # A standard deviation below a hundredth of a gray level is no contrast.
    some = (below > 1e-4 * first.size) & (above > 1e-4 * first.size)
    gain = jnp.where(some, above, 1.0) / jnp.where(some, below, 1.0)
    return lax.stop_gradient(jnp.clip(gain, 0.125, 8.0))


def _quantiles(pyramid: tuple[Float[Array, "_ _"], ...]) -> Float[Array, " s"]:
    """Sorted gray levels of evenly spaced samples of a coarse level, which has little noise."""
    level = pyramid[min(2, len(pyramid) - 1)]
    stride = max(1, round((level.size / _SAMPLES) ** 0.5))
    return jnp.sort(lax.stop_gradient(level)[::stride, ::stride].reshape(-1))


def _shapes(shape: tuple[int, int], levels: int) -> list[tuple[int, int]]:
    """Rows and columns of each level."""
    return [(-(-shape[0] // 2**level), -(-shape[1] // 2**level)) for level in range(levels)]


def _corners(shape: tuple[int, int], levels: int, margin: int) -> list[tuple[int, int]]:
    """Position (column, row) of each padded level in the atlas."""
    corners, column = [(0, 0)], 0
    for _, width in _shapes(shape, levels)[1:]:
        corners.append((column, shape[0] + 2 * margin))
        column += width + 2 * margin
    return corners


def _atlas_shape(shape: tuple[int, int], levels: int, margin: int) -> tuple[int, int]:
    sides = [(rows + 2 * margin, columns + 2 * margin) for rows, columns in _shapes(shape, levels)]
    below = sides[1:]
    height = sides[0][0] + max((rows for rows, _ in below), default=0)
    return height, max(sides[0][1], sum(columns for _, columns in below))
