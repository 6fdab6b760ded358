"""Occupancy grid maps and their free space."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from jaxloc._arguments import checked
from jaxloc.poses import SE2

_GOLDEN = 0.6180339887498949


class OccupancyMap(eqx.Module):
    """An occupancy grid: the probability of each cell to be occupied.

    Cell (row, column) covers the square whose lower left corner lies at ``origin @ (column, row) * resolution``: rows
    grow with y. (Image files have their first row at the top; the reader flips them.)

    Args:
        probability: "rows columns", of being occupied.
        resolution: edge of a cell, m.
        origin: ``T_world_map``, the pose of the lower left corner of cell (0, 0).
        occupied_above: threshold of occupied cells.
        free_below: threshold of free cells; those in between are unknown.

    References:
        Moravec and Elfes, "High resolution maps from wide angle sonar", ICRA 1985; the ROS ``map_server`` for names.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> grid = jl.sensors.OccupancyMap(jnp.array([[0.0, 0.5, 1.0]]), 0.1, jl.poses.SE2(2.0, 0.0, 0.0))
        >>> grid.free.tolist(), grid.occupied.tolist()
        ([[True, False, False]], [[False, False, True]])
        >>> [round(x, 3) for x in grid.to_world(jnp.array([[2.0, 0.0]]))[0].tolist()]
        [2.25, 0.05]
    """

    probability: Float[Array, "rows columns"]
    resolution: Float[Array, ""]
    origin: SE2
    occupied_above: float = eqx.field(static=True, default=0.65)
    free_below: float = eqx.field(static=True, default=0.196)

    def __init__(
        self,
        probability: Float[Array, "rows columns"],
        resolution: Any,
        origin: SE2,
        occupied_above: float = 0.65,
        free_below: float = 0.196,
    ):
        self.probability = probability
        self.resolution = jnp.asarray(resolution, probability.dtype)
        self.origin = origin
        self.occupied_above = occupied_above
        self.free_below = free_below

    @property
    def occupied(self) -> Bool[Array, "rows columns"]:
        """Mask of the occupied cells."""
        return self.probability > self.occupied_above

    @property
    def free(self) -> Bool[Array, "rows columns"]:
        """Mask of the free cells."""
        return self.probability < self.free_below

    @property
    def surfaces(self) -> Bool[Array, "rows columns"]:
        """Occupied cells with a free cell among their eight neighbors; all occupied cells if there is none."""
        padded = jnp.pad(self.free, 1)
        rows, columns = self.free.shape
        beside = jnp.zeros_like(self.free)
        for row in range(3):
            for column in range(3):
                beside = beside | padded[row : row + rows, column : column + columns]
        found = self.occupied & beside
        return jnp.where(jnp.any(found), found, self.occupied)

    @checked
    def to_cells(self, points: Float[Array, "n 2"]) -> Float[Array, "n 2"]:
        """Grid coordinates (column, row), centers of cells at integers, of points of the world (m)."""
        return self.origin.inverse().apply(points) / self.resolution - 0.5

    @checked
    def to_world(self, cells: Float[Array, "n 2"]) -> Float[Array, "n 2"]:
        """Points of the world (m) of grid coordinates (column, row)."""
        return self.origin.apply((cells + 0.5) * self.resolution)

    def free_space(self) -> "FreeSpace":
        """The free cells, to sample poses from. They are listed on the host: do not call it under `jit`.

        Raises:
            ValueError: no cell is free.
        """
        rows, columns = np.nonzero(np.asarray(self.free))
        if not rows.size:
            raise ValueError("The map has no free cell: there is no free space to sample poses from.")
        return FreeSpace(jnp.asarray(np.stack([columns, rows], 1), jnp.int32), self.resolution, self.origin)


class FreeSpace(eqx.Module):
    """Free cells of a map, to sample poses of a robot from.

    Args:
        cells: "k 2" (column, row).
        resolution: edge of a cell, m.
        origin: ``T_world_map``.
    """

    cells: Int[Array, "k 2"]
    resolution: Float[Array, ""]
    origin: SE2

    @property
    def area(self) -> Float[Array, ""]:
        """Area of the free cells, m^2."""
        return self.cells.shape[0] * self.resolution**2

    @checked
    def sample_evenly(self, num_poses: int, *, key: Key[Array, ""]) -> SE2:
        """Poses evenly distributed over the free cells and all headings, with one random shift of the pattern.

        Even patterns have smaller gaps than independent samples: fewer poses cover a map.
        """
        shift, within = jax.random.split(key)
        dtype = self.resolution.dtype
        offset = jax.random.uniform(shift, (2,), dtype)
        # Integer and fractional steps are kept apart: the products exceed 32-bit precision.
        steps, rest = np.divmod(np.arange(num_poses) * self.cells.shape[0], num_poses)
        width = self.cells.shape[0] / num_poses
        fraction = jnp.asarray(rest / num_poses, dtype) + width * offset[0]
        index = (jnp.asarray(steps, jnp.int32) + fraction.astype(jnp.int32)) % self.cells.shape[0]
        turn = jnp.asarray(np.arange(num_poses) * _GOLDEN % 1.0, dtype)
        return self._poses(index, 2.0 * jnp.pi * (turn + offset[1]), within)

    @checked
    def sample(self, num_poses: int, *, key: Key[Array, ""]) -> SE2:
        """Independent poses, uniform over the free cells and all headings."""
        place, heading, within = jax.random.split(key, 3)
        index = jax.random.randint(place, (num_poses,), 0, self.cells.shape[0])
        return self._poses(
            index, 2.0 * jnp.pi * jax.random.uniform(heading, (num_poses,), self.resolution.dtype), within
        )

    def _poses(self, index: Array, heading: Array, key: Key[Array, ""]) -> SE2:
        cells = self.cells.at[index].get(mode="promise_in_bounds").astype(self.resolution.dtype)
        xy = (cells + jax.random.uniform(key, cells.shape, cells.dtype)) * self.resolution
        return jax.vmap(lambda p, angle: self.origin @ SE2(p[0], p[1], angle))(xy, heading)
