"""Sums of products of patches and windows per pixel cell, for Gauss-Newton steps without access to pixels.

Bilinear interpolation is linear in the image: `I(x + c + f) = sum_ij w_ij(f) I(x + c + (i, j))` for a whole pixel c
and a fraction f in the unit cell. So the sums of template times image at any f are the same mean of four sums, and one
pass over the pixels serves any number of steps within a cell.
"""

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxloc._xla import compute_once
from jaxloc.images.patches import slice_windows


class PatchSums(eqx.Module):
    """Centered sums of n patches; the three maps of a template are its slopes right and down and its values.

    Attributes:
        gram: Products of the template's maps with each other.
        cross: Products of the template's maps with the image at the four corners (down, right) of the pixel cell.
    """

    gram: Float[Array, "3 3 n"]
    cross: Float[Array, "2 2 3 n"]


class CellSolution(eqx.Module):
    """Solution within a cell.

    Attributes:
        fraction: Position (right, down) from the cell's corner; outside the unit cell it is extrapolated.
        step: Length of the last step.
        regular: Whether the template determines both coordinates.
    """

    fraction: Float[Array, "2 n"]
    step: Float[Array, " n"]
    regular: Bool[Array, " n"]


def cut_window(image: Float[Array, "h w"], corner: Int[Array, "n 2"], size: int) -> Float[Array, "p p n"]:
    """Cuts `size + 1` square windows, points along the last axis, each relative to its center pixel.

    Example:
        >>> import jax.numpy as jnp
        >>> cut_window(jnp.arange(36.0).reshape(6, 6), jnp.array([[1, 0]]), 3)[2, :, 0].tolist()
        [-2.0, -1.0, 0.0, 1.0]
    """
    windows = slice_windows(image, corner, (size + 1, size + 1))
    # Relative to the center, since sums of large products are inaccurate in float32.
    center = windows[:, (size + 1) // 2, (size + 1) // 2]
    return jnp.transpose(windows - center[:, None, None], (1, 2, 0))


def sum_patches(
    source: Float[Array, "r r n"], fraction: Float[Array, "2 n"], window: Float[Array, "q q n"]
) -> PatchSums:
    """Sums over all pixels of each patch, one row at a time to fit the cache.

    Args:
        source: Windows of the first image with one pixel more to the left and above, two to the right and below.
        fraction: Offset (right, down) of the templates from the source's pixels.
        window: Windows of the second image with one pixel more to the right and below.

    Returns:
        Sums of products of template and window, both less their means.

    Example:
        >>> import jax.numpy as jnp
        >>> ramp = jnp.broadcast_to(jnp.arange(6.0)[None, :, None], (6, 6, 1))
        >>> sums = sum_patches(ramp, jnp.zeros((2, 1)), ramp[:4, :4])
        >>> float(sums.gram[2, 2, 0]), float(sums.cross[0, 1, 2, 0])
        (6.0, 6.0)
    """
    size, count = window.shape[0] - 1, window.shape[2]
    template = compute_once(shift, source, fraction)
    inner = template[1:-1, 1:-1]
    slopes = 0.5 * (template[1:-1, 2:] - template[1:-1, :-2]), 0.5 * (template[2:, 1:-1] - template[:-2, 1:-1])
    # The last map, of ones, gives the sums for subtraction of the means.
    maps = jnp.stack([*slopes, inner, jnp.ones_like(inner)], axis=2)

    def add_row(row, sums):
        line = lax.dynamic_index_in_dim(maps, row, 0, keepdims=False)
        near = lax.dynamic_slice(window, (row, 0, 0), (2, size + 1, count))
        gram, *cross = sums
        gram = gram + sum(line[k, :3, None] * line[k, None] for k in range(size))
        return gram, *(x + sum(near[:, k + j, None] * line[None, k] for k in range(size)) for j, x in enumerate(cross))

    zeros = tuple(jnp.zeros((*shape, count), dtype=window.dtype) for shape in ((3, 4), (2, 4), (2, 4)))
    gram, *cross = lax.fori_loop(0, size, add_row, zeros)
    total, cross = gram[:, 3], jnp.stack(cross, axis=1)
    mean = total / float(size * size)
    return PatchSums(gram[:, :3] - total[:, None] * mean[None], cross[:, :, :3] - mean[None, None] * cross[:, :, 3:])


def shift(pixels: Float[Array, "p q n"], fraction: Float[Array, "2 n"]) -> Float[Array, "p2 q2 n"]:
    """Shifts each patch by its fraction (right, down) of a pixel, bilinearly; without its last row and column.

    Example:
        >>> import jax.numpy as jnp
        >>> shift(jnp.arange(4.0).reshape(2, 2, 1), jnp.array([[0.5], [0.0]])).tolist()
        [[[0.5]]]
    """
    right, down = fraction[:, None, None]
    mixed = (1.0 - down) * pixels[:-1] + down * pixels[1:]
    return (1.0 - right) * mixed[:, :-1] + right * mixed[:, 1:]


def regress(
    sums: PatchSums, fraction: Float[Array, "2 n"], gains: Float[Array, "2 *n"]
) -> tuple[Float[Array, "2 n"], Float[Array, " n"]]:
    """Gauss-Newton step and gain at a position in the cell, the gain clipped to two bounds.

    Minimizes `sum (I - g T - b - g s d)^2` over d, g and b with slopes s of the template; for a gain beyond its bounds,
    the others are those at the bound.

    Args:
        sums: Sums of the patches.
        fraction: Position from the corner of the cell.
        gains: Least and greatest gain.

    Returns:
        The step d to be subtracted from the position, and the gain.

    Example:
        >>> import jax.numpy as jnp
        >>> ramp = jnp.broadcast_to(jnp.arange(6.0)[None, :, None] ** 2, (6, 6, 1))
        >>> sums = sum_patches(ramp, jnp.zeros((2, 1)), 0.5 * ramp[:4, :4])
        >>> bool(jnp.isfinite(regress(sums, jnp.zeros((2, 1)), jnp.array([0.1, 9.0]))[0]).all())
        True
    """
    (a, b, p), (_, c, q), (_, _, e) = sums.gram
    x, y, z = at_fraction(sums, fraction)
    determinant, regular = determinant_of(sums)
    safe = jnp.where(regular, determinant, 1.0)
    # Parts of the template and of the image that the slopes do not explain.
    along_u, along_v = (c * p - b * q) / safe, (a * q - b * p) / safe
    rest = e - along_u * p - along_v * q
    free = jnp.where(regular & (rest > 1e-6 * e), z - along_u * x - along_v * y, 1.0)
    gain = jnp.clip(free / jnp.where(regular & (rest > 1e-6 * e), rest, 1.0), gains[0], gains[1])
    step_u, step_v = x - gain * p, y - gain * q
    step = jnp.stack([c * step_u - b * step_v, a * step_v - b * step_u]) / (safe * gain)[None]
    return jnp.where(regular[None], step, 0.0), gain


def at_fraction(sums: PatchSums, fraction: Float[Array, "2 n"]) -> Float[Array, "3 n"]:
    """Products of the template's maps with the image at a position in the cell.

    Example:
        >>> import jax.numpy as jnp
        >>> sums = PatchSums(jnp.ones((3, 3, 1)), jnp.arange(12.0).reshape(2, 2, 3, 1))
        >>> at_fraction(sums, jnp.array([[0.5], [0.0]]))[:, 0].tolist()
        [1.5, 2.5, 3.5]
    """
    right, down = fraction[0], fraction[1]
    mixed = (1.0 - down)[None, None] * sums.cross[0] + down[None, None] * sums.cross[1]
    return (1.0 - right)[None] * mixed[0] + right[None] * mixed[1]


def determinant_of(sums: PatchSums) -> tuple[Float[Array, " n"], Bool[Array, " n"]]:
    """Determinant of the structure matrix, and whether the patch has texture in both directions.

    Example:
        >>> import jax.numpy as jnp
        >>> sums = PatchSums(jnp.eye(3)[:, :, None], jnp.zeros((2, 2, 3, 1)))
        >>> [x.tolist() for x in determinant_of(sums)]
        [[1.0], [True]]
    """
    (a, b, _), (_, c, _), (_, _, energy) = sums.gram
    determinant, trace = a * c - b * b, a + c
    return determinant, (energy > 1e-3) & (trace > 1e-5 * energy) & (determinant > 1e-3 * trace * trace)


def solve_cell(
    sums: PatchSums, fraction: Float[Array, "2 n"], gains: Float[Array, "2 *n"], num_steps: int
) -> CellSolution:
    """Takes Gauss-Newton steps within the cell, at most half a pixel beyond it.

    Example:
        >>> import jax.numpy as jnp
        >>> sums = PatchSums(jnp.eye(3)[:, :, None], jnp.zeros((2, 2, 3, 1)))
        >>> solve_cell(sums, jnp.full((2, 1), 0.5), jnp.array([0.5, 2.0]), 3).fraction.tolist()
        [[0.5], [0.5]]
    """

    def advance(_, state):
        at, _ = state
        moved = jnp.clip(at - regress(sums, at, gains)[0], -0.5, 1.5)
        return moved, jnp.max(jnp.abs(moved - at), axis=0)

    fraction, step = lax.fori_loop(0, num_steps, advance, (fraction, jnp.zeros_like(fraction[0])))
    return CellSolution(fraction, step, determinant_of(sums)[1])


def split_pixel(coordinate: Float[Array, "n 2"]) -> tuple[Int[Array, "n 2"], Float[Array, "n 2"]]:
    """Splits coordinates into whole pixels and fractions.

    Example:
        >>> import jax.numpy as jnp
        >>> [x.tolist() for x in split_pixel(jnp.array([[1.5, -0.25]]))]
        [[[1, -1]], [[0.5, 0.75]]]
    """
    whole = lax.stop_gradient(jnp.floor(coordinate))
    return whole.astype(jnp.int32), coordinate - whole
