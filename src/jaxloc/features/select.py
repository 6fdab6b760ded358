"""Evenly distributed selection of points: per grid cell, by square covering, local maxima; coverage of an image."""

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxloc._jit import filter_jit

# Bisections of the side of the square in `cover_squares`.
_BISECTIONS = 12


class Selection(eqx.Module):
    """Selected points of a set.

    Attributes:
        index: The point of each slot; 0 in empty slots.
        valid: False in empty slots.
    """

    index: Int[Array, " k"]
    valid: Bool[Array, " k"]


class Peaks(eqx.Module):
    """Local maxima of a response image.

    Attributes:
        uv: Pixel coordinates (right, down) of the maxima; 0 in empty slots.
        response: Their responses; 0 in empty slots.
        valid: False in empty slots.
    """

    uv: Float[Array, "k 2"]
    response: Float[Array, " k"]
    valid: Bool[Array, " k"]


class Coverage(eqx.Module):
    """Coverage of an image by a set of points.

    Attributes:
        counts: Points in each cell.
        filled: Fraction of the cells that hold a point.
        entropy: Entropy of the fractions of points in cells over that of a uniform distribution, 0 to 1.
    """

    counts: Int[Array, "rows columns"]
    filled: Float[Array, ""]
    entropy: Float[Array, ""]


@filter_jit
def select_by_grid(
    uv: Float[Array, "n 2"],
    score: Float[Array, " n"],
    valid: Bool[Array, " n"],
    *,
    shape: tuple[int, int],
    grid: tuple[int, int],
    capacity: int,
    per_cell: int | None = None,
) -> Selection:
    """Selects points in rounds over the cells of a grid, the best remaining one of each cell.

    Args:
        uv: Pixel coordinates (right, down).
        score: Quality; greater is better.
        valid: Points that exist.
        shape: Static image size (rows, columns), px.
        grid: Static number of cells (rows, columns).
        capacity: Static number of slots of the result.
        per_cell: Greatest number of points of a cell; None lets full cells make up for empty ones.

    Returns:
        Indices in the order of the rounds: the first slots are distributed as evenly as all of them.

    References:
        Even distribution of features by a grid [T-70].

    Example:
        >>> import jax.numpy as jnp
        >>> uv = jnp.array([[1.0, 1.0], [2.0, 1.0], [9.0, 9.0]])
        >>> score, valid = jnp.array([3.0, 2.0, 1.0]), jnp.ones(3, bool)
        >>> select_by_grid(uv, score, valid, shape=(10, 10), grid=(2, 2), capacity=2).index.tolist()
        [0, 2]
    """
    n = uv.shape[0]
    cell = jnp.where(valid, cells(uv, shape=shape, grid=grid), grid[0] * grid[1])
    by_cell = jnp.lexsort((-score, cell))
    sorted_cell = cell[by_cell]
    first = jnp.searchsorted(sorted_cell, sorted_cell, side="left").astype(jnp.int32)
    rank = jnp.zeros(n, dtype=jnp.int32).at[by_cell].set(jnp.arange(n, dtype=jnp.int32) - first)
    allowed = valid if per_cell is None else valid & (rank < per_cell)
    order = jnp.lexsort((-score, jnp.where(allowed, rank, n)))[:capacity].astype(jnp.int32)
    chosen = jnp.pad(allowed[order], (0, max(capacity - n, 0)))
    index = jnp.pad(order, (0, max(capacity - n, 0)))
    return Selection(jnp.where(chosen, index, 0), chosen)


def local_peaks(
    response: Float[Array, "h w"],
    *,
    grid: tuple[int, int],
    per_cell: int,
    radius: int = 1,
    threshold: float | Float[Array, ""] = 0.0,
) -> Peaks:
    """The strongest local maxima of each cell of a grid.

    Args:
        response: A response image, for example of `harris.harris`.
        grid: Static number of cells (rows, columns).
        per_cell: Static number of maxima a cell.
        radius: A maximum exceeds or equals all pixels within this many rows and columns.
        threshold: A maximum exceeds this response.

    Returns:
        `rows * columns * per_cell` slots, cell by cell, strongest first.

    References:
        Even distribution of features by a grid [T-70].

    Example:
        >>> import jax.numpy as jnp
        >>> response = jnp.zeros((8, 8)).at[2, 3].set(5.0)
        >>> peaks = local_peaks(response, grid=(2, 2), per_cell=1)
        >>> peaks.uv[0].tolist(), peaks.valid.tolist()
        ([3.0, 2.0], [True, False, False, False])
    """
    return _local_peaks(response, grid, per_cell, radius, jnp.asarray(threshold, response.dtype))


@filter_jit
def _local_peaks(response, grid: tuple[int, int], per_cell: int, radius: int, threshold) -> Peaks:
    side = 2 * radius + 1
    highest = lax.reduce_window(response, -jnp.inf, lax.max, (side, side), (1, 1), "SAME")
    peak = (response >= highest) & (response > threshold)
    height, width = -(-response.shape[0] // grid[0]), -(-response.shape[1] // grid[1])
    padding = ((0, height * grid[0] - response.shape[0]), (0, width * grid[1] - response.shape[1]))
    blocks = jnp.pad(jnp.where(peak, response, -jnp.inf), padding, constant_values=-jnp.inf)
    blocks = blocks.reshape(grid[0], height, grid[1], width).transpose(0, 2, 1, 3).reshape(-1, height * width)
    best, at = lax.top_k(blocks, min(per_cell, height * width))
    cell = jnp.arange(grid[0] * grid[1], dtype=at.dtype)[:, None]
    u, v = (cell % grid[1]) * width + at % width, (cell // grid[1]) * height + at // width
    valid = (best > -jnp.inf).reshape(-1)
    uv = jnp.stack([u.reshape(-1), v.reshape(-1)], axis=1).astype(response.dtype)
    return Peaks(jnp.where(valid[:, None], uv, 0.0), jnp.where(valid, best.reshape(-1), 0.0), valid)


@filter_jit
def coverage(
    uv: Float[Array, "n 2"], valid: Bool[Array, " n"], *, shape: tuple[int, int], grid: tuple[int, int]
) -> Coverage:
    """Evenness of points over an image, `entropy = -sum p log p / log(cells)` of the fractions p of points in cells.

    Args:
        uv: Pixel coordinates (right, down).
        valid: Points that exist.
        shape: Static image size (rows, columns), px.
        grid: Static number of cells (rows, columns).

    Returns:
        Counts, share of filled cells and normalized entropy; all zero for an empty set.

    References:
        Coverage of a grid [T-70].

    Example:
        >>> import jax.numpy as jnp
        >>> uv = jnp.array([[1.0, 1.0], [9.0, 1.0]])
        >>> float(coverage(uv, jnp.ones(2, bool), shape=(10, 10), grid=(1, 2)).filled)
        1.0
    """
    total = grid[0] * grid[1]
    cell = jnp.where(valid, cells(uv, shape=shape, grid=grid), total)
    counts = jnp.zeros(total, dtype=jnp.int32).at[cell].add(1, mode="drop")
    some = counts > 0
    share = counts.astype(uv.dtype) / jnp.maximum(counts.sum(), 1).astype(uv.dtype)
    terms = jnp.where(some, -share * jnp.log(jnp.where(some, share, 1.0)), 0.0)
    entropy = terms.sum() / jnp.log(jnp.asarray(max(total, 2), uv.dtype))
    return Coverage(counts.reshape(grid), some.astype(uv.dtype).mean(), entropy)


def cells(uv: Float[Array, "n 2"], *, shape: tuple[int, int], grid: tuple[int, int]) -> Int[Array, " n"]:
    """Row-major number of the grid cell of each pixel; pixels outside belong to the nearest cell.

    Example:
        >>> import jax.numpy as jnp
        >>> cells(jnp.array([[1.0, 9.0]]), shape=(10, 10), grid=(2, 2)).tolist()
        [2]
    """
    column = jnp.clip(uv[:, 0] * (grid[1] / shape[1]), 0, grid[1] - 1).astype(jnp.int32)
    row = jnp.clip(uv[:, 1] * (grid[0] / shape[0]), 0, grid[0] - 1).astype(jnp.int32)
    return row * grid[1] + column


@filter_jit
def cover_squares(
    uv: Float[Array, "n 2"],
    score: Float[Array, " n"],
    valid: Bool[Array, " n"],
    *,
    shape: tuple[int, int],
    capacity: int,
) -> Selection:
    """Selects points at least half a square apart, with the greatest square that still fills the slots (SSC).

    Points are visited by decreasing score; each suppresses weaker ones in the square around it. The side of the square
    is found by bisection, so that at least `capacity` points are left, and the strongest of those are kept.

    Args:
        uv: Pixel coordinates (right, down).
        score: Quality; greater is better.
        valid: Points that exist.
        shape: Static image size (rows, columns), px.
        capacity: Static number of slots of the result.

    Returns:
        Indices, strongest first; all valid points where there are fewer than slots.

    References:
        Bailo, Rameau, Joo, Park, Bogdan, Kweon, "Efficient adaptive non-maximal suppression algorithms for homogeneous
        spatial keypoint distribution", Pattern Recognition Letters 2018 (SSC).

    Example:
        >>> import jax.numpy as jnp
        >>> uv = jnp.array([[1.0, 1.0], [2.0, 1.0], [9.0, 9.0]])
        >>> cover_squares(uv, jnp.array([3.0, 2.0, 1.0]), jnp.ones(3, bool), shape=(10, 10), capacity=2).index.tolist()
        [0, 2]
    """
    n = uv.shape[0]
    order = jnp.lexsort((-score, ~valid)).astype(jnp.int32)
    places = jnp.where(valid[:, None], lax.stop_gradient(uv), 0.0)[order]
    present = valid[order]

    def bisect(_: Array, state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        low, high, best = state
        side = 0.5 * (low + high)
        kept = _kept(places, present, side)
        enough = jnp.sum(kept) >= min(capacity, n)
        return jnp.where(enough, side, low), jnp.where(enough, high, side), jnp.where(enough, kept, best)

    far = jnp.asarray(float(max(shape)), uv.dtype)
    _, _, best = lax.fori_loop(0, _BISECTIONS, bisect, (jnp.zeros_like(far), far, present))
    rank = jnp.argsort(~best, stable=True)[:capacity]
    chosen = jnp.pad(best[rank], (0, max(capacity - n, 0)))
    index = jnp.pad(order[rank], (0, max(capacity - n, 0)))
    return Selection(jnp.where(chosen, index, 0), chosen)


def _kept(places: Float[Array, "n 2"], present: Bool[Array, " n"], side: Float[Array, ""]) -> Bool[Array, " n"]:
    """Points that remain when each kept one suppresses weaker ones within half a side along both axes."""

    def visit(free: Array, k: Array) -> tuple[Array, Array]:
        keep = free[k]
        near = jnp.max(jnp.abs(places - places[k][None, :]), axis=1) < 0.5 * side
        return free & ~(keep & near), keep

    return lax.scan(visit, present, jnp.arange(places.shape[0], dtype=jnp.int32))[1]
