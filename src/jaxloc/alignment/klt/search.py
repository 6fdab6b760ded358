"""Coarse-to-fine search in a fixed number of slots, each point at its own pyramid level."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxloc.alignment.klt.frames import Frame, level_corners, level_sizes
from jaxloc.alignment.klt.patch_sums import cut_window, solve_cell, split_pixel, sum_patches
from jaxloc.alignment.klt.records import Klt


class Found(eqx.Module):
    """Found positions with the sums of their patches.

    Attributes:
        cell: Whole pixel of the first pixel of the patch in the second frame.
        fraction: Position from there.
        gram: Sums of products of the template's maps, row by row.
        cross: Sums of their products with the image at the corners of the cell.
    """

    cell: Int[Array, "n 2"]
    fraction: Float[Array, "n 2"]
    gram: Float[Array, "n 9"]
    cross: Float[Array, "n 12"]


class _Slots(eqx.Module):
    """Points in progress, each at its own level, the queue, and the log of finished ones."""

    index: Int[Array, " c"]
    level: Int[Array, " c"]
    rounds: Int[Array, " c"]
    offset: Float[Array, "c 2"]
    waiting: Int[Array, ""]
    finished: Int[Array, ""]
    order: Int[Array, " m"]
    found: Found


def search(
    previous: Frame,
    current: Frame,
    points: Float[Array, "n 2"],
    offset: Float[Array, "n 2"],
    gains: Float[Array, " 2"],
    options: Klt,
) -> Found:
    """Displacements of all points from the coarsest level to the finest, without derivatives.

    A round cuts the patches of all slots, each from the current level of its point, and moves the points within their
    pixel cells. A converged point goes to the next level; a finished one is replaced by the next in the queue. So no
    point waits for the slowest, all levels and points share one small program, and its data fit the cache.

    Args:
        previous: First frame.
        current: Second frame.
        points: Pixels of the first frame; finite.
        offset: Initial displacements, px.
        gains: Least and greatest gain.
        options: Patches, rounds and slots.

    Returns:
        The found positions.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> from jaxloc.alignment.klt.frames import build_frame
        >>> image = 100 * jax.random.uniform(jax.random.key(0), (60, 60))
        >>> first, second = build_frame(image, 1, 12), build_frame(jnp.roll(image, 1, axis=1), 1, 12)
        >>> near = jnp.array([[0.4, 0.2]])
        >>> found = search(first, second, jnp.array([[30.0, 30.0]]), near, jnp.array([0.8, 1.2]), Klt())
        >>> (found.cell + jnp.round(found.fraction).astype(int) + 10).tolist()
        [[31, 30]]
    """
    previous, current, points, offset = lax.stop_gradient((previous, current, points, offset))
    count, top, dtype = points.shape[0], previous.levels - 1, previous.atlas.dtype
    width = min(options.chunk, count)
    empty = Found(
        *(jnp.zeros((count + width, k), dtype=d) for k, d in ((2, jnp.int32), (2, dtype), (9, dtype), (12, dtype)))
    )
    if count == 0:
        return empty
    corners, sizes = level_corners(previous), level_sizes(previous)
    initial = offset * 0.5**top

    def advance(slots: _Slots) -> _Slots:
        busy = slots.index < count
        index = jnp.minimum(slots.index, count - 1)
        level = slots.level
        uv = points[index] * jnp.exp2(-level.astype(points.dtype))[:, None]
        moved, converged, fit = _round(
            previous.atlas, current.atlas, uv, slots.offset, gains, corners[level], sizes[level], level, options
        )
        finished = converged | (slots.rounds + 1 >= options.max_rounds)
        done = busy & finished & (level == 0)
        # A scatter is slow on a CPU. Finished points are moved to the front, and all are appended as one block, whose
        # unfinished part the next block overwrites.
        first = jnp.argsort(~done)

        def append(log, new):
            return lax.dynamic_update_slice_in_dim(log, new[first], slots.finished, 0)

        following = slots.waiting + jnp.cumsum(done, dtype=jnp.int32) - 1
        index = jnp.where(done, jnp.minimum(following, count), slots.index)
        fresh = initial[jnp.minimum(index, count - 1)]
        onward = jnp.where((finished & (level > 0))[:, None], 2.0 * moved, moved)
        return _Slots(
            index,
            jnp.where(done, top, jnp.where(finished, jnp.maximum(level - 1, 0), level)),
            jnp.where(finished, 0, slots.rounds + 1),
            jnp.where(done[:, None], fresh, onward),
            slots.waiting + jnp.sum(done, dtype=jnp.int32),
            slots.finished + jnp.sum(done, dtype=jnp.int32),
            append(slots.order, slots.index),
            jax.tree.map(append, slots.found, fit),
        )

    line, none = jnp.arange(width, dtype=jnp.int32), jnp.zeros(width, dtype=jnp.int32)
    log = jnp.full(count + width, count, dtype=jnp.int32)
    slots = _Slots(line, none + top, none, initial[:width], jnp.int32(width), jnp.int32(0), log, empty)
    slots = lax.while_loop(lambda slots: slots.finished < count, advance, slots)
    where = jnp.argsort(slots.order[:count])
    return jax.tree.map(lambda log: log[where], slots.found)


def _round(previous, current, uv, offset, gains, corner, size, level, options: Klt):
    """Moves points within their pixel cells: offsets, which have converged, and their sums."""
    dtype = previous.dtype
    last = (size - 1).astype(uv.dtype)
    uv = jnp.clip(uv, 0.0, last)
    half = options.size // 2
    # The border is repeated, so that points may be anywhere on the level.
    at, below = split_pixel(uv - (half + 1))
    source = cut_window(previous, at + corner, options.size + 2)
    target = jnp.clip(uv + offset, 0.0, last)
    cell, fraction = split_pixel(target - half)
    window = cut_window(current, cell + corner, options.size)
    sums = sum_patches(source, below.T.astype(dtype), window)
    solution = solve_cell(sums, fraction.T.astype(dtype), gains, options.num_steps)
    beyond = jnp.max(jnp.abs(solution.fraction - 0.5), axis=0) - 0.5
    # Just beyond the cell is accurate enough at coarse levels.
    converged = (beyond < jnp.where(level > 0, 0.3, 0.05)) & (solution.step < 0.05)
    moved = jnp.clip(cell.astype(uv.dtype) + half + solution.fraction.T.astype(uv.dtype), 0.0, last) - uv
    moved = jnp.where(solution.regular[:, None], moved, offset)
    width = uv.shape[0]
    fit = Found(cell, solution.fraction.T, sums.gram.reshape(9, width).T, sums.cross.reshape(12, width).T)
    return moved, converged | ~solution.regular, fit
