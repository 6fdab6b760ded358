"""Sparsity structure of a bundle: index tables that are made once, on the host.

Sums over ragged sets (the images of a point, the points of an image, the images that share points) use padded
rows of fixed length, so that bundles of the same size share a compiled program.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxloc._arguments import checked

# Lengths of the rows; short for points, which have few images each.
_ROW_POINT, _ROW_CAMERA, _ROW_PAIR = 4, 32, 16


class Groups(eqx.Module):
    """Ragged groups of items as padded rows.

    Attributes:
        members: items of each row; the number of items where a row has ended.
        owner: group of each row, ascending.
        count: number of groups.
    """

    members: Int[Array, "g k"]
    owner: Int[Array, " g"]
    count: int = eqx.field(static=True)

    @staticmethod
    def of(group: np.ndarray, count: int, row: int, size: int) -> "Groups":
        """Groups of items 0, 1, ... that belong to ``group[item]``; ``size`` marks empty entries."""
        members, owner = _rows(np.asarray(group), row)
        order = np.append(np.argsort(group, kind="stable"), size)
        return Groups(jnp.asarray(order[members], jnp.int32), jnp.asarray(owner, jnp.int32), count)

    @checked
    def sum(self, rows: Float[Array, "m f"]) -> Float[Array, "c f"]:
        """Sum of the rows of each group."""
        padded = with_zero(rows)
        total = jnp.sum(padded[self.members], axis=1)
        return jax.ops.segment_sum(total, self.owner, self.count, indices_are_sorted=True)


class Structure(eqx.Module):
    """Index tables of observations by camera and by point, and of pairs of observations of one point.

    Attributes:
        by_camera: observations of each camera.
        by_point: observations of each point.
        first: first observation of each pair, in padded rows; the camera of the first is not before that of the second.
        second: second observation.
        block: number of the camera pair of each row, ascending.
        block_row: first camera of each pair of cameras that share points.
        block_column: second camera.
    """

    by_camera: Groups
    by_point: Groups
    first: Int[Array, "h k"]
    second: Int[Array, "h k"]
    block: Int[Array, " h"]
    block_row: Int[Array, " b"]
    block_column: Int[Array, " b"]

    @staticmethod
    def of(camera: Any, point: Any, *, num_cameras: int, num_points: int) -> "Structure":
        """The tables of a bundle; memory is proportional to the sum of the squared numbers of images of the points.

        Args:
            camera: "m", index of the camera of each observation; concrete numbers, on the host.
            point: "m", index of its point.
            num_cameras: how many cameras there are.
            num_points: how many points there are.

        Returns:
            The tables. They are arrays: bundles with tables of the same sizes share a compiled program.

        Raises:
            ValueError: numbers that are traced, of different lengths, none, or out of range.

        Example:
            >>> import jaxloc.refinement.bundle.structure as structure
            >>> tables = structure.Structure.of([0, 1, 0], [0, 0, 1], num_cameras=2, num_points=2)
            >>> tables.block_row.tolist(), tables.block_column.tolist()
            ([0, 1, 1], [0, 0, 1])
        """
        if any(isinstance(index, jax.core.Tracer) for index in (camera, point)):
            raise ValueError("The structure of a bundle is made on the host: make it before jit, and pass it in.")
        camera, point = np.asarray(camera), np.asarray(point)
        _check("camera", camera, num_cameras, len(point))
        _check("point", point, num_points, len(camera))
        first, second = _pairs(camera, point)
        block = camera[first].astype(np.int64) * num_cameras + camera[second]
        order = np.argsort(block, kind="stable")
        blocks, number = np.unique(block[order], return_inverse=True)
        members, owner = _rows(number, _ROW_PAIR)
        ends = (np.append(end[order], len(camera))[members] for end in (first, second))
        arrays = (*ends, owner, *np.divmod(blocks, num_cameras))
        return Structure(
            Groups.of(camera, num_cameras, _ROW_CAMERA, len(camera)),
            Groups.of(point, num_points, _ROW_POINT, len(camera)),
            *(jnp.asarray(array, jnp.int32) for array in arrays),
        )


@checked
def with_zero(rows: Float[Array, "m *f"]) -> Float[Array, "n *f"]:
    """The rows and one of zeros, for empty entries of tables."""
    return jnp.concatenate([rows, jnp.zeros((1, *rows.shape[1:]), rows.dtype)])


def _check(name: str, index: np.ndarray, count: int, length: int) -> None:
    if index.ndim != 1 or len(index) != length or not len(index) or not np.issubdtype(index.dtype, np.integer):
        raise ValueError(
            f"Indices of the {name}s have shape {index.shape} and type {index.dtype}: needs integers, one for each "
            f"observation, at least one, and as many cameras as points ({length})."
        )
    if index.min() < 0 or index.max() >= count:
        raise ValueError(f"Indices of the {name}s are from {index.min()} to {index.max()}, but there are only {count}.")


def _rows(group: np.ndarray, row: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions in the sorted order of groups, divided into rows, and the group of each row."""
    counts = np.bincount(group)
    lines = -(-counts // row)
    owner = np.repeat(np.arange(len(counts)), lines)
    begin = np.cumsum(counts) - counts
    place_in_group = np.arange(len(owner)) - np.repeat(np.cumsum(lines) - lines, lines)
    members = place_in_group[:, None] * row + np.arange(row)[None, :]
    inside = members < counts[owner][:, None]
    return np.where(inside, members + begin[owner][:, None], len(group)), owner


def _pairs(camera: np.ndarray, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of observations of one point: each with itself, with those of cameras before, both ways in one camera."""
    order = np.lexsort((camera, point))
    sorted_point = point[order]
    first, second = [order], [order]
    for step in range(1, int(np.bincount(point).max())):
        same = np.flatnonzero(sorted_point[step:] == sorted_point[:-step])
        near, far = order[same], order[same + step]
        twice = camera[near] == camera[far]
        first += [far, near[twice]]
        second += [near, far[twice]]
    return np.concatenate(first), np.concatenate(second)
