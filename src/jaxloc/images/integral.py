"""Integral images: exact sums over rectangles from their four corners."""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Num

from jaxloc._jit import filter_jit


@filter_jit
def integral(image: Num[Array, "h w"]) -> Num[Array, "h1 w1"]:
    """Integral image: sums over all pixels above and to the left, ``S[i, j] = sum of image[:i, :j]``.

    Sums of integers may overflow; their differences are exact nevertheless, if the sum over the box fits.

    Args:
        image: gray levels; small integers are summed as int32.

    Returns:
        One row and one column more than the image, the first of each zero.

    References:
        Crow, "Summed-area tables for texture mapping", SIGGRAPH 1984; thesis eq. 2.37 [T-36].

    Example:
        >>> import jax.numpy as jnp
        >>> integral(jnp.array([[1, 2], [3, 4]])).tolist()
        [[0, 0, 0], [0, 1, 3], [0, 4, 10]]
    """
    floating = jnp.issubdtype(image.dtype, jnp.inexact)
    if not floating and image.dtype.itemsize <= 4:
        image = image.astype(jnp.int32)
    return jnp.pad(jnp.cumsum(jnp.cumsum(image, axis=0), axis=1), ((1, 0), (1, 0)))


@filter_jit
def box_sums(sums: Num[Array, "h1 w1"], boxes: Int[Array, "n 4"]) -> Num[Array, " n"]:
    """Sums over rectangles of any size, by four reads each.

    Args:
        sums: an integral image.
        boxes: (top, left, bottom, right): rows from top to bottom - 1, columns from left to right - 1. What lies
            outside of the image counts as zero, and so does an empty box.

    Returns:
        The sums: exact for integers, else to the rounding of the whole image's sum.

    References:
        Viola and Jones, CVPR 2001; thesis eq. 2.37 [T-36].

    Example:
        >>> import jax.numpy as jnp
        >>> sums = integral(jnp.array([[1, 2, 3], [4, 5, 6]]))
        >>> box_sums(sums, jnp.array([[0, 0, 2, 3], [1, 1, 2, 3], [0, 0, 9, 1]])).tolist()
        [21, 11, 5]
    """
    height, width = sums.shape[0] - 1, sums.shape[1] - 1
    top, bottom = (jnp.clip(boxes[:, k], 0, height) for k in (0, 2))
    left, right = (jnp.clip(boxes[:, k], 0, width) for k in (1, 3))
    bottom, right = jnp.maximum(bottom, top), jnp.maximum(right, left)
    return (sums[bottom, right] - sums[top, right]) - (sums[bottom, left] - sums[top, left])


@partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def filter_boxes(
    linear: Callable[..., tuple[Array, ...]], largest: int, image: Float[Array, "h w"], *places: Array
) -> tuple[Array, ...]:
    """Box filters of a float32 image without the rounding errors of sums over the whole image.

    Gray levels become fixed-point integers, as fine as the largest filter allows, whose sums are exact modulo
    2^32. A float64 image is summed directly. Derivatives are those of the linear filter.

    Args:
        linear: maps an integral image and places to sums of boxes by additions and subtractions, in any dtype. Static.
        largest: greatest sum of absolute weights of a filter, pixels; static.
        image: gray levels.
        places: further arguments of `linear`.

    Returns:
        What `linear` returns, in the image's dtype.

    Example:
        >>> import jax.numpy as jnp
        >>> image = jnp.full((2000, 2000), 254.5).at[1500, 1500].set(255.0)
        >>> whole = lambda sums: (sums[1501, 1501] - sums[1500, 1501] - sums[1501, 1500] + sums[1500, 1500],)
        >>> float(filter_boxes(whole, 1, image)[0]), float(whole(integral(image))[0]) == 255.0
        (255.0, False)
    """
    if image.dtype == jnp.float64:
        return linear(integral(image), *places)
    highest = jnp.maximum(jnp.max(jnp.abs(image)), jnp.asarray(1e-20, image.dtype))
    # A power of two, so that whole gray levels are exact.
    scale = jnp.exp2(jnp.floor(jnp.log2((2.0**31 - 1.0) / largest / highest)) - 1.0)
    whole = jnp.round(image * scale).astype(jnp.int32)
    return tuple(part.astype(image.dtype) / scale for part in linear(integral(whole), *places))


@filter_boxes.defjvp
def _(linear: Callable, largest: int, primals: tuple, tangents: tuple) -> tuple:
    image, *places = primals
    return filter_boxes(linear, largest, image, *places), linear(integral(tangents[0]), *places)
