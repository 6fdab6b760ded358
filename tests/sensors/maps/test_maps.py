"""Occupancy maps and distance fields, beside SciPy's transform."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage

from jaxloc.poses import SE2
from jaxloc.sensors import DistanceField, OccupancyMap
from jaxloc.sensors.maps.distance_field import squared_distances


def random_map(rng, shape=(23, 31), dtype=jnp.float32, part=0.05):
    probability = (rng.uniform(size=shape) < part).astype(np.float64)
    return OccupancyMap(jnp.asarray(probability, dtype), 0.5, SE2(jnp.asarray(1.0, dtype), -2.0, 0.7))


@pytest.mark.parametrize("part", [0.001, 0.02, 0.3])
def test_distances_are_exact(rng, part):
    occupied = rng.uniform(size=(41, 67)) < part
    occupied[3, 60] = True
    expected = ndimage.distance_transform_edt(~occupied) ** 2
    np.testing.assert_allclose(squared_distances(jnp.asarray(occupied)), expected, atol=1e-3)


@pytest.mark.parametrize("shape", [(1, 9), (9, 1), (1, 1)])
def test_thin_grids(shape):
    occupied = np.zeros(shape, bool)
    occupied[-1, -1] = True
    expected = ndimage.distance_transform_edt(~occupied) ** 2
    np.testing.assert_allclose(squared_distances(jnp.asarray(occupied)), expected)


def test_a_map_without_obstacles_is_far_from_all():
    assert float(squared_distances(jnp.zeros((4, 5), bool)).min()) > 4**2 + 5**2
    field = DistanceField.of(OccupancyMap(jnp.zeros((4, 5)), 0.1, SE2.identity()), ceiling=3.0)
    # Nothing is ever nearer than the map is large.
    assert float(field.distance.min()) > 0.1 * np.hypot(4, 5)


def test_surfaces_are_the_occupied_cells_beside_free_ones():
    probability = np.full((7, 9), 0.5, np.float32)
    probability[:, 1:4] = 1.0
    probability[:, 4:7] = 0.0
    grid = OccupancyMap(jnp.asarray(probability), 0.1, SE2.identity())
    assert np.unique(np.argwhere(np.asarray(grid.surfaces))[:, 1]).tolist() == [3]
    field = DistanceField.of(grid, surfaces=True)
    np.testing.assert_allclose(field.distance[0], 0.1 * np.array([3, 2, 1, 0, 1, 2, 3, 4, 5]), atol=1e-6)
    closed = OccupancyMap(jnp.ones((3, 3)), 0.1, SE2.identity())
    assert bool(closed.surfaces.all())


def test_cells_and_world(rng, dtype):
    grid = random_map(rng, dtype=dtype)
    cells = jnp.asarray(rng.uniform(-3, 30, (7, 2)), dtype)
    points = grid.to_world(cells)
    assert points.dtype == dtype
    np.testing.assert_allclose(grid.to_cells(points), cells, atol=2e-5)
    cos, sin = np.cos(0.7), np.sin(0.7)
    expected = (np.asarray(cells) + 0.5) * 0.5 @ np.array([[cos, sin], [-sin, cos]]) + [1.0, -2.0]
    np.testing.assert_allclose(points, expected, atol=2e-5)


def test_unknown_is_neither_free_nor_occupied():
    grid = OccupancyMap(jnp.array([[0.0, 0.196, 0.5, 0.65, 1.0]]), 0.1, SE2.identity())
    assert grid.free.tolist() == [[True, False, False, False, False]]
    assert grid.occupied.tolist() == [[False, False, False, False, True]]


def test_bilinear_lookup(rng, dtype):
    field = DistanceField.of(random_map(rng, dtype=dtype), ceiling=4.0)
    assert field.distance.dtype == dtype
    u, v = jnp.asarray(rng.uniform(0, 30, 50), dtype), jnp.asarray(rng.uniform(0, 22, 50), dtype)
    expected = ndimage.map_coordinates(np.asarray(field.distance, np.float64), [v, u], order=1)
    np.testing.assert_allclose(field.lookup(u, v), expected, atol=1e-5)
    np.testing.assert_allclose(field.lookup(jnp.array([30.0], dtype), jnp.array([22.0], dtype)), field.distance[22, 30])


def test_outside_the_distance_goes_on_up_to_the_ceiling(rng):
    field = DistanceField.of(random_map(rng), ceiling=4.0)
    border = field.distance[10, 30]
    values = field.lookup(jnp.array([30.0, 31.0, 32.0, 1e4]), jnp.full(4, 10.0))
    np.testing.assert_allclose(values, jnp.minimum(border + jnp.array([0.0, 0.5, 1.0, 1e9]), 4.0), rtol=1e-6)
    bad = field.at(jnp.array([[jnp.nan, 0.0], [jnp.inf, 1.0]]))
    assert bad.tolist() == [4.0, 4.0]


def test_gradients_reach_map_and_place(x64, rng):
    field = DistanceField.of(random_map(rng, dtype=jnp.float64), ceiling=jnp.asarray(50.0))
    points = jnp.asarray(rng.uniform(0, 6, (5, 2)))

    def total(points, distance):
        return jnp.sum(DistanceField(distance, field.resolution, field.origin, field.ceiling).at(points) ** 2)

    by_points, by_map = jax.grad(total, (0, 1))(points, field.distance)
    assert jnp.all(jnp.isfinite(by_points)) and float(jnp.sum(by_map != 0)) <= 4 * 5
    for index in np.ndindex(5, 2):
        step = jnp.zeros((5, 2)).at[index].set(1e-6)
        slope = (total(points + step, field.distance) - total(points - step, field.distance)) / 2e-6
        assert float(by_points[index]) == pytest.approx(float(slope), rel=1e-4, abs=1e-6)
    direction = jnp.asarray(rng.standard_normal(field.distance.shape))
    slope = (total(points, field.distance + 1e-6 * direction) - total(points, field.distance - 1e-6 * direction)) / 2e-6
    assert float(jnp.sum(by_map * direction)) == pytest.approx(float(slope), rel=1e-6)


def test_a_place_on_the_border_has_a_finite_gradient(rng):
    field = DistanceField.of(random_map(rng), ceiling=4.0)
    for u in (0.0, 30.0, 35.0):
        assert np.isfinite(jax.grad(lambda x: field.lookup(x, jnp.array(3.0)))(jnp.array(u)))


def test_poses_of_the_free_space(rng):
    grid = random_map(rng, part=0.5)
    space = grid.free_space()
    assert float(space.area) == pytest.approx(float(jnp.sum(grid.free)) * 0.25)
    for poses in (space.spread(3000, key=jax.random.key(0)), space.sample(3000, key=jax.random.key(0))):
        cells = np.rint(np.asarray(grid.to_cells(poses.translation))).astype(int)
        assert np.asarray(grid.free)[cells[:, 1], cells[:, 0]].mean() > 0.99  # but for rounding at the edges of cells
        counts = np.unique(cells, axis=0, return_counts=True)[1]
        assert len(counts) >= 0.99 * len(space.cells)
        headings = np.histogram(np.arctan2(poses.rotation.sin, poses.rotation.cos), 8, (-np.pi, np.pi))[0]
        assert headings.min() > 3000 / 8 * 0.8
    even = np.unique(np.asarray(space.spread(len(space.cells), key=jax.random.key(1)).translation // 1e-9), axis=0)
    assert len(even) == len(space.cells)


def test_no_free_cell_is_an_error():
    with pytest.raises(ValueError, match="no free cell"):
        OccupancyMap(jnp.ones((3, 3)), 0.1, SE2.identity()).free_space()
