"""Distance fields of occupancy maps: differentiable distances to the nearest obstacle, and ray casting."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxloc._arguments import checked
from jaxloc._jit import filter_jit
from jaxloc.poses import SE2
from jaxloc.sensors.maps.occupancy_map import OccupancyMap


class DistanceField(eqx.Module):
    """A distance field: the distance to the nearest obstacle at every cell center, bilinear in between.

    Outside the grid it is the nearest border value plus the distance to the border, up to `ceiling`, so that it is
    continuous everywhere. It is differentiable in its values (the map) and in the point.

    Args:
        distance: "rows columns", m.
        resolution: edge of a cell, m.
        origin: ``T_world_map``.
        ceiling: largest distance of the field, m.

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
    @filter_jit
    @checked
    def of(grid: OccupancyMap, *, ceiling: float | Float[Array, ""] = 2.0, surfaces: bool = False) -> "DistanceField":
        """The exact Euclidean field of the occupied cells of a map.

        Args:
            grid: the map.
            surfaces: use only occupied cells beside free ones as obstacles, so that distances inside thick walls are
                not zero and the field locates the surfaces that sensors measure.
            ceiling: largest distance, m; the size of the map for ray casting, a few standard deviations of a range for
                end points of beams.
        """
        dtype = grid.resolution.dtype
        ceiling = jnp.asarray(ceiling, dtype)
        obstacles = grid.surfaces if surfaces else grid.occupied
        cells = jnp.sqrt(squared_distances(obstacles, dtype=dtype))
        return DistanceField(jnp.minimum(cells * grid.resolution, ceiling), grid.resolution, grid.origin, ceiling)

    @checked
    def to_grid(self, pose: SE2, x: Float[Array, "*n"], y: Float[Array, "*n"]) -> tuple[Array, Array]:
        """Grid coordinates (column, row) of points in the frame of a pose in the world.

        Map origin, pose and scale are combined to one similarity first, so that a point costs four products.
        """
        local = self.origin.inverse() @ pose
        cos, sin = local.rotation.cos / self.resolution, local.rotation.sin / self.resolution
        shift = local.translation / self.resolution - 0.5
        return shift[0] + (cos * x - sin * y), shift[1] + (sin * x + cos * y)

    @checked
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

    @checked
    def at(self, points: Float[Array, "n 2"]) -> Float[Array, " n"]:
        """Distances (m) at points of the world (m); the ceiling at non-finite points."""
        finite = jnp.all(jnp.isfinite(points), axis=1)
        safe = jnp.where(finite[:, None], points, 0.0)
        u, v = self.to_grid(SE2.identity(points.dtype), safe[:, 0], safe[:, 1])
        return jnp.where(finite, self.lookup(u, v), self.ceiling)

    def _beyond(self, du: Array, dv: Array) -> Array:
        """Distance of a point outside the rectangle of cell centers, m; its derivative inside is zero, not NaN."""
        squared = du**2 + dv**2
        outside = squared > 0.0
        return jnp.where(outside, self.resolution * jnp.sqrt(jnp.where(outside, squared, 1.0)), 0.0)


@filter_jit
@checked
def squared_distances(
    occupied: Bool[Array, "rows columns"], *, dtype: Any = jnp.float32
) -> Float[Array, "rows columns"]:
    """Squared Euclidean distance of every cell to the nearest occupied one, in cells; exact.

    First along the columns by cumulative extrema, then along the rows: ``min_k f(x + k) + k^2`` is found by repeated
    minima with both neighbors plus 1, 3, 5, ..., since the first k odd numbers sum to ``k^2``. It stops when nothing
    changes.

    Args:
        occupied: obstacles.
        dtype: of the result; in float32 distances are exact up to 4096 cells.

    Returns:
        Squared distances; larger than any in the grid when nothing is occupied.

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

    initial = (squared, jnp.zeros((), dtype), jnp.array(True))
    return lax.while_loop(lambda carry: carry[2], widen, initial)[0]


@filter_jit
@checked
def trace(
    field: DistanceField,
    pose: SE2,
    angles: Float[Array, " b"],
    *,
    max_range: float | Float[Array, ""],
    num_steps: int = 40,
) -> Float[Array, " b"]:
    """Ray casting by sphere tracing: ranges from a pose to the obstacles of a map.

    A ray ends half a cell short of the center of an occupied cell, at its face. After the steps, which carry no
    derivative, one Newton step on ``d(range) = face`` gives the exact derivative of the solution.

    Args:
        field: of the map; the larger its ceiling, the fewer steps are needed.
        pose: ``T_world_laser``.
        angles: of the rays in the laser's frame, rad.
        max_range: range of rays without an obstacle, m.
        num_steps: number of steps; rays that need more end short of the obstacle.

    Returns:
        Ranges "b", m.

    References:
        Hart, "Sphere tracing", The Visual Computer 1996.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> wall = jnp.zeros((40, 60)).at[:, 50].set(1.0)
        >>> field = jl.sensors.DistanceField.of(jl.sensors.OccupancyMap(wall, 0.1, jl.poses.SE2.identity()))
        >>> pose, angles = jl.poses.SE2(2.0, 2.0, 0.0), jnp.array([0.0, jnp.pi])
        >>> [round(x, 3) for x in jl.sensors.beam_model.trace(field, pose, angles, max_range=8.0).tolist()]
        [3.0, 8.0]
    """
    cos, sin = jnp.cos(angles), jnp.sin(angles)
    face = 0.5 * field.resolution

    def gap(place: SE2, values: DistanceField, length: Array) -> Array:
        return values.lookup(*values.to_grid(place, length * cos, length * sin)) - face

    fixed, still = lax.stop_gradient(pose), lax.stop_gradient(field)
    limit = lax.stop_gradient(jnp.asarray(max_range, field.resolution.dtype))

    def advance(_, length):
        return jnp.minimum(length + jnp.maximum(gap(fixed, still, length), 0.0), limit)

    length = lax.stop_gradient(lax.fori_loop(0, num_steps, advance, jnp.zeros_like(angles)))
    # Slope along the ray by a difference over a cell, since the field is not smooth.
    slope = (gap(fixed, still, length) - gap(fixed, still, jnp.maximum(length - face, 0.0))) / face
    refined = length - gap(pose, field, length) / jnp.minimum(slope, -0.1)
    hit = (length < limit) & (gap(fixed, still, length) < face)
    return jnp.where(hit, jnp.clip(refined, 0.0, limit), length)
