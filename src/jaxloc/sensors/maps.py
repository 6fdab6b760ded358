"""Occupancy grids of the plane, and distance fields: how far the nearest obstacle is, differentiable."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key

from jaxloc.poses import SE2

_GOLDEN = 0.6180339887498949


class OccupancyMap(eqx.Module):
    """A grid of cells, each with the probability that something stands in it.

    Cell (row, column) covers the square whose lower left corner lies at ``origin @ (column, row) * resolution``: rows
    grow with y. (Image files have their first row at the top; the reader turns them over.)

    Args:
        probability: "rows columns", of being occupied.
        resolution: edge of a cell, m.
        origin: ``T_world_map``, the pose of the lower left corner of cell (0, 0).
        occupied_above: cells of greater probability are obstacles.
        free_below: cells of smaller probability are free; those in between are unknown.

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
        """Cells with an obstacle."""
        return self.probability > self.occupied_above

    @property
    def free(self) -> Bool[Array, "rows columns"]:
        """Cells known to be empty."""
        return self.probability < self.free_below

    @property
    def surfaces(self) -> Bool[Array, "rows columns"]:
        """Occupied cells with a free one among the eight around them; all occupied ones where there is none such."""
        padded = jnp.pad(self.free, 1)
        rows, columns = self.free.shape
        beside = jnp.zeros_like(self.free)
        for row in range(3):
            for column in range(3):
                beside = beside | padded[row : row + rows, column : column + columns]
        found = self.occupied & beside
        return jnp.where(jnp.any(found), found, self.occupied)

    def to_cells(self, points: Float[Array, "n 2"]) -> Float[Array, "n 2"]:
        """Grid coordinates (column, row), centers of cells at integers, of points of the world (m)."""
        return self.origin.inverse().apply(points) / self.resolution - 0.5

    def to_world(self, cells: Float[Array, "n 2"]) -> Float[Array, "n 2"]:
        """Points of the world (m) of grid coordinates (column, row)."""
        return self.origin.apply((cells + 0.5) * self.resolution)

    def free_space(self) -> "FreeSpace":
        """The free cells, to draw poses from. Lists them on the host: not to be called under `jit`.

        Raises:
            ValueError: no cell is free.
        """
        rows, columns = np.nonzero(np.asarray(self.free))
        if not rows.size:
            raise ValueError("The map has no free cell: nowhere to start.")
        return FreeSpace(jnp.asarray(np.stack([columns, rows], 1), jnp.int32), self.resolution, self.origin)


class FreeSpace(eqx.Module):
    """Cells in which a robot may be.

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
        """In m^2."""
        return self.cells.shape[0] * self.resolution**2

    def spread(self, num_poses: int, *, key: Key[Array, ""]) -> SE2:
        """Poses spread evenly over the free cells and all headings, with one random shift of the whole pattern.

        Even patterns leave no gaps as large as those of independent draws: fewer poses cover a map.
        """
        shift, within = jax.random.split(key)
        dtype = self.resolution.dtype
        offset = jax.random.uniform(shift, (2,), dtype)
        # Whole and fractional steps apart: the index stays exact where it exceeds what a 32-bit number can hold.
        steps, rest = np.divmod(np.arange(num_poses) * self.cells.shape[0], num_poses)
        width = self.cells.shape[0] / num_poses
        fraction = jnp.asarray(rest / num_poses, dtype) + width * offset[0]
        index = (jnp.asarray(steps, jnp.int32) + fraction.astype(jnp.int32)) % self.cells.shape[0]
        turn = jnp.asarray(np.arange(num_poses) * _GOLDEN % 1.0, dtype)
        return self._poses(index, 2.0 * jnp.pi * (turn + offset[1]), within)

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


class DistanceField(eqx.Module):
    """The distance to the nearest obstacle at every cell center, bilinear in between.

    Outside the grid it goes on from the nearest border value by the distance to the border, up to `ceiling`, so that it
    is continuous everywhere. Gradients reach the values of the field (the map) and the point.

    Args:
        distance: "rows columns", m.
        resolution: edge of a cell, m.
        origin: ``T_world_map``.
        ceiling: the greatest distance that is told apart, m.

    References:
        Thrun, Burgard, Fox, *Probabilistic Robotics*, 2005, section 6.4.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> grid = jl.sensors.OccupancyMap(jnp.zeros((1, 9)).at[0, 0].set(1.0), 1.0, jl.poses.SE2.identity())
        >>> field = jl.sensors.DistanceField.of(grid, ceiling=10.0)
        >>> field.at(jnp.array([[0.5, 0.5], [4.75, 0.5], [10.5, 0.5]])).tolist()
        [0.0, 4.25, 10.0]
    """

    distance: Float[Array, "rows columns"]
    resolution: Float[Array, ""]
    origin: SE2
    ceiling: Float[Array, ""]

    @staticmethod
    @eqx.filter_jit
    def of(grid: OccupancyMap, *, ceiling: float | Float[Array, ""] = 2.0, surfaces: bool = False) -> "DistanceField":
        """The exact Euclidean field of the occupied cells of a map.

        Args:
            grid: the map.
            surfaces: count only occupied cells beside free ones, so that the inside of a thick wall is far from it,
                too; where a sensor sees surfaces, this tells where they are to less than the wall is thick.
            ceiling: distances are cut there, m; rays need the map's size, end points of beams a few sigmas.
        """
        dtype = grid.resolution.dtype
        ceiling = jnp.asarray(ceiling, dtype)
        obstacles = grid.surfaces if surfaces else grid.occupied
        cells = jnp.sqrt(squared_distances(obstacles, dtype=dtype))
        return DistanceField(jnp.minimum(cells * grid.resolution, ceiling), grid.resolution, grid.origin, ceiling)

    def to_grid(self, pose: SE2, x: Float[Array, "*n"], y: Float[Array, "*n"]) -> tuple[Array, Array]:
        """Grid coordinates (column, row) of points in the frame of a pose of the world.

        Map origin, pose and scale are made one similarity first, so that a point costs four products.
        """
        local = self.origin.inverse() @ pose
        cos, sin = local.rotation.cos / self.resolution, local.rotation.sin / self.resolution
        start = local.translation / self.resolution - 0.5
        return start[0] + (cos * x - sin * y), start[1] + (sin * x + cos * y)

    def lookup(self, u: Float[Array, "*n"], v: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Distances (m) at finite grid coordinates (column u, row v), bilinear."""
        rows, columns = self.distance.shape
        u_in, v_in = jnp.clip(u, 0.0, columns - 1.0), jnp.clip(v, 0.0, rows - 1.0)
        column = jnp.minimum(u_in.astype(jnp.int32), max(columns - 2, 0))
        row = jnp.minimum(v_in.astype(jnp.int32), max(rows - 2, 0))
        a, b = u_in - column.astype(u.dtype), v_in - row.astype(u.dtype)
        right, up = min(1, columns - 1), min(1, rows - 1) * columns
        first = row * columns + column
        flat = self.distance.reshape(-1)
        low, low_right, high, high_right = (
            flat.at[first + step].get(mode="promise_in_bounds") for step in (0, right, up, up + right)
        )
        inside = (1.0 - b) * (low + a * (low_right - low)) + b * (high + a * (high_right - high))
        return jnp.minimum(inside + self._beyond(u - u_in, v - v_in), self.ceiling)

    def at(self, points: Float[Array, "n 2"]) -> Float[Array, " n"]:
        """Distances (m) at points of the world (m); a point that is not finite is as far as the ceiling."""
        finite = jnp.all(jnp.isfinite(points), axis=1)
        safe = jnp.where(finite[:, None], points, 0.0)
        u, v = self.to_grid(SE2.identity(points.dtype), safe[:, 0], safe[:, 1])
        return jnp.where(finite, self.lookup(u, v), self.ceiling)

    def _beyond(self, du: Array, dv: Array) -> Array:
        """How far a point lies outside the rectangle of cell centers, m; its derivative inside is zero, not NaN."""
        squared = du**2 + dv**2
        outside = squared > 0.0
        return jnp.where(outside, self.resolution * jnp.sqrt(jnp.where(outside, squared, 1.0)), 0.0)


@eqx.filter_jit
def squared_distances(
    occupied: Bool[Array, "rows columns"], *, dtype: Any = jnp.float32
) -> Float[Array, "rows columns"]:
    """Squared Euclidean distance of every cell to the nearest occupied one, in cells; exact.

    First along the columns by running extremes, then along the rows: ``min_k f(x + k) + k^2`` is reached by repeated
    minima with both neighbors raised by 1, 3, 5, ..., since the first k odd numbers sum to ``k^2``. It stops when
    nothing changes, after as many rounds as the farthest sideways neighbor needs.

    Args:
        occupied: obstacles.
        dtype: of the result; in float32 distances are exact up to 4096 cells.

    Returns:
        Squared distances; far greater than any in the grid when nothing is occupied.

    References:
        Huang and Mitchell, "A Euclidean distance transform using grayscale morphology decomposition", PAMI 1994.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> jl.sensors.maps.squared_distances(jnp.zeros((2, 3), bool).at[0, 0].set(True)).tolist()
        [[0.0, 1.0, 4.0], [1.0, 2.0, 5.0]]
    """
    rows, columns = occupied.shape
    far = float(rows + columns)
    index = jnp.broadcast_to(jnp.arange(rows, dtype=dtype)[:, None], (rows, columns))
    below = index - lax.cummax(jnp.where(occupied, index, -far), axis=0)
    above = lax.cummin(jnp.where(occupied, index, rows + far), axis=0, reverse=True) - index
    squared = jnp.minimum(jnp.minimum(below, above), far) ** 2
    edge = jnp.full((rows, 1), 2.0 * far * far, dtype)

    def widen(carry):
        values, step, _ = carry
        left = jnp.concatenate([edge, values[:, :-1]], axis=1)
        right = jnp.concatenate([values[:, 1:], edge], axis=1)
        wider = jnp.minimum(values, jnp.minimum(left, right) + (2.0 * step + 1.0))
        return wider, step + 1.0, jnp.any(wider < values)

    start = (squared, jnp.zeros((), dtype), jnp.array(True))
    return lax.while_loop(lambda carry: carry[2], widen, start)[0]
