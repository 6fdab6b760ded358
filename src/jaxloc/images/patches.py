"""Extraction of fixed-size patches around many subpixel centers."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxloc._jit import filter_jit
from jaxloc.images.interpolation import AbstractInterpolation, Bilinear


class Patches(eqx.Module):
    """Patches cut out of an image.

    Attributes:
        values: One patch a point, rows by columns; zero where the patch leaves the image.
        inside: True where the whole patch lies on the image.
    """

    values: Float[Array, "n p q"]
    inside: Bool[Array, " n"]


@filter_jit
def extract(
    image: Float[Array, "h w"],
    uv: Float[Array, "n 2"],
    *,
    size: int | tuple[int, int],
    method: AbstractInterpolation | None = None,
) -> Patches:
    """Extracts a patch around each point.

    All pixels of a patch have the same subpixel offset, so that each patch is one contiguous slice that
    is shifted once: an order of magnitude faster than sampling pixel by pixel. Pixel `[i, j]` of a patch is the
    image at `uv + (j - (q - 1) / 2, i - (p - 1) / 2)`; the values equal those of `interpolation.sample`.

    Args:
        image: Grayscale image.
        uv: Patch centers, pixel coordinates (right, down).
        size: Static side of the patch in pixels, or (rows, columns); odd sizes have a pixel at their center.
        method: `Bilinear()` (the default) or `Bicubic()`.

    Returns:
        The patches and which of them lie wholly inside; others are zero and have no gradient.

    Raises:
        ValueError: The patch is larger than the image.

    Example:
        >>> import jax.numpy as jnp
        >>> ramp = jnp.broadcast_to(jnp.arange(8.0)[None, :], (8, 8))
        >>> patches = extract(ramp, jnp.array([[3.5, 4.0], [0.0, 0.0]]), size=3)
        >>> patches.values[0, 1].tolist(), patches.inside.tolist()
        ([2.5, 3.5, 4.5], [True, False])
    """
    method = Bilinear() if method is None else method
    rows, columns = (size, size) if isinstance(size, int) else size
    if rows > image.shape[0] or columns > image.shape[1]:
        raise ValueError(f"extract: a patch of {rows}x{columns} pixels does not fit an image of shape {image.shape}.")
    corner = uv - 0.5 * jnp.array([columns - 1, rows - 1], dtype=uv.dtype)[None, :]
    last = jnp.array([image.shape[1] - columns, image.shape[0] - rows], dtype=uv.dtype)
    inside = jnp.all((corner >= 0) & (corner <= last[None, :]), axis=1)
    corner = jnp.where(inside[:, None], corner, 0.0)
    base = jnp.floor(corner).astype(jnp.int32)
    fraction = (corner - base.astype(uv.dtype)).astype(image.dtype)
    extra = method.taps - 1
    # A margin for the neighbors of the outermost pixels, so that patches may touch the border.
    padded = jnp.pad(image, ((-method.first, extra + method.first),) * 2, mode="edge")
    windows = slice_windows(padded, base, (rows + extra, columns + extra))
    shifted = shift_windows(windows, fraction, method)
    return Patches(jnp.where(inside[:, None, None], shifted, 0.0), inside)


def slice_windows(
    image: Float[Array, "h w"], corner: Int[Array, "n 2"], size: tuple[int, int]
) -> Float[Array, "n p q"]:
    """Copies a window of `size = (rows, columns)` with its first pixel at each `corner = (column, row)`.

    Windows that exceed the image are moved into it, as `lax.dynamic_slice` does.

    Example:
        >>> import jax.numpy as jnp
        >>> slice_windows(jnp.arange(12.0).reshape(3, 4), jnp.array([[1, 0]]), (2, 2)).tolist()
        [[[1.0, 2.0], [5.0, 6.0]]]
    """
    return jax.vmap(lambda at: lax.dynamic_slice(image, (at[1], at[0]), size))(corner)


def shift_windows(
    windows: Float[Array, "n p q"], fraction: Float[Array, "n 2"], method: AbstractInterpolation
) -> Float[Array, "n p2 q2"]:
    """Shifts each window by its own constant fraction of a pixel; the result has `taps - 1` fewer rows and columns.

    Example:
        >>> import jax.numpy as jnp
        >>> shift_windows(jnp.array([[[0.0, 1.0], [2.0, 3.0]]]), jnp.array([[0.5, 0.5]]), Bilinear()).tolist()
        [[[1.5]]]
    """
    rows, columns = (side - method.taps + 1 for side in windows.shape[1:])
    weights_v = [weight[:, None, None] for weight in method.weights(fraction[:, 1])]
    weights_u = [weight[:, None, None] for weight in method.weights(fraction[:, 0])]
    mixed = sum(weight * windows[:, k : k + rows] for k, weight in enumerate(weights_v))
    return sum(weight * mixed[:, :, k : k + columns] for k, weight in enumerate(weights_u))
