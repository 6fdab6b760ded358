"""The determinant of the Hessian by box filters, on the octaves of SURF."""

import math
from functools import partial

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxloc._jit import filter_jit
from jaxloc.images.integral import filter_boxes

# Blur of the Gaussian that the smallest filter, nine pixels wide, stands for.
_SIGMA, _SMALLEST = 1.2, 9
LAYERS = 4


class BoxHessian(eqx.Module):
    """Box-filter Hessian responses of an octave.

    Attributes:
        determinant: of the Hessian, squared gray levels; one layer a size of the filter.
        trace: of the Hessian, gray levels; positive on dark blobs.
        step: distance of two samples, px.
    """

    determinant: Float[Array, "s h w"]
    trace: Float[Array, "s h w"]
    step: int = eqx.field(static=True)


def filter_sizes(octave: int) -> tuple[int, ...]:
    """Sides of the box filters of an octave, px: 9, 15, 21, 27; 15, 27, 39, 51; 27, 51, ...

    Args:
        octave: from zero.

    References:
        Bay, Ess, Tuytelaars, Van Gool, "Speeded-up robust features (SURF)", CVIU 2008, section 3.3.

    Example:
        >>> filter_sizes(1)
        (15, 27, 39, 51)
    """
    return tuple(3 * (2 ** (octave + 1) * (layer + 1) + 1) for layer in range(LAYERS))


def filter_scale(size: Float[Array, " n"]) -> Float[Array, " n"]:
    """Standard deviation of the Gaussian that a box filter of this side approximates, px.

    Example:
        >>> import jax.numpy as jnp
        >>> round(float(filter_scale(jnp.array([9.0]))[0]), 6)
        1.2
    """
    return size * (_SIGMA / _SMALLEST)


@filter_jit
def box_hessian(image: Float[Array, "h w"], *, octave: int = 0, weight: float = 0.9) -> BoxHessian:
    """Second derivatives of a Gaussian by boxes: ``det = D_uu D_vv - (w D_uv)^2``, every filter divided by its area.

    The three lobes of D_uu lie side by side, a third of the side wide; the four of D_uv leave the middle row and column
    out. The image is continued by its border.

    Args:
        image: gray levels.
        octave: from zero; sizes of `filter_sizes`, every ``2^octave``-th pixel. Static.
        weight: w, which makes up for the boxes: ratio of the Frobenius norms of the filters to those of Gaussians.

    Returns:
        Four layers.

    References:
        Bay et al. 2008, section 3.2; thesis eq. 2.40 [T-37].

    Example:
        >>> import jax.numpy as jnp
        >>> u, v = jnp.meshgrid(jnp.arange(41.0) - 20, jnp.arange(41.0) - 20)
        >>> found = box_hessian(100.0 * jnp.exp(-(u**2 + v**2) / (2 * 2.4**2)))
        >>> int(jnp.argmax(found.determinant[:, 20, 20])), bool(found.trace[1, 20, 20] < 0)
        (1, True)
    """
    lobes = [size // 3 for size in filter_sizes(octave)]
    step, margin = 2**octave, (3 * lobes[-1]) // 2 + 1
    height, width = image.shape
    rows, columns = (height - 1) // step + 1, (width - 1) // step + 1
    read = partial(_derivatives, margin=margin, step=step, rows=rows, columns=columns)
    wide = jnp.pad(image, margin, mode="edge")
    areas = [9.0 * lobe * lobe for lobe in lobes]
    # Absolute weights of D_uu: the lobes at the sides once, the middle twice.
    largest = 4 * lobes[-1] * (2 * lobes[-1] - 1)
    uu, vv, uv = filter_boxes(read, largest, wide, jnp.asarray(lobes, jnp.int32))
    share = (1.0 / jnp.asarray(areas, image.dtype))[:, None, None]
    uu, vv, uv = uu * share, vv * share, uv * share
    return BoxHessian(uu * vv - weight * weight * uv * uv, uu + vv, step)


def _derivatives(
    sums: Array, lobes: Int[Array, " s"], *, margin: int, step: int, rows: int, columns: int
) -> tuple[Array, Array, Array]:
    """Sums of D_uu, D_vv and D_uv for every width of a lobe."""
    size = ((rows - 1) * step + 1, (columns - 1) * step + 1)

    def of(lobe: Int[Array, ""]) -> tuple[Array, Array, Array]:
        def corner(down: Array, right: Array) -> Array:
            start = (margin + down, margin + right)
            return lax.dynamic_slice(sums, start, size)[::step, ::step]

        def box(top: Array, left: Array, high: Array, wide: Array) -> Array:
            bottom, right = top + high, left + wide
            return (corner(bottom, right) - corner(top, right)) - (corner(bottom, left) - corner(top, left))

        whole, half, third, across = 3 * lobe, (3 * lobe) // 2, lobe // 2, 2 * lobe - 1
        one = jnp.ones_like(lobe)
        uu = box(1 - lobe, -half, across, whole) - 3 * box(1 - lobe, -third, across, lobe)
        vv = box(-half, 1 - lobe, whole, across) - 3 * box(-third, 1 - lobe, lobe, across)
        uv = box(-lobe, -lobe, lobe, lobe) + box(one, one, lobe, lobe)
        return uu, vv, uv - box(-lobe, one, lobe, lobe) - box(one, -lobe, lobe, lobe)

    # One program for all sizes: it compiles faster than one a size.
    return lax.map(of, lobes)


def max_octaves(shape: tuple[int, int], most: int) -> int:
    """Number of octaves whose largest filter fits into the image, at least one.

    Example:
        >>> max_octaves((128, 200), 4), max_octaves((640, 480), 4)
        (3, 4)
    """
    room = (min(shape) - 1) / 3.0
    return max(1, min(most, math.floor(math.log2(max((room - 1.0) / LAYERS, 2.0)))))
