"""Occupancy maps: coordinates, thresholds, surfaces, free space."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.poses import SE2
from jaxloc.sensors import DistanceField, OccupancyMap


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


def test_cells_and_world(rng, dtype, random_map):
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


def test_poses_of_the_free_space(rng, random_map):
    grid = random_map(rng, part=0.5)
    space = grid.free_space()
    assert float(space.area) == pytest.approx(float(jnp.sum(grid.free)) * 0.25)
    for poses in (space.sample_evenly(3000, key=jax.random.key(0)), space.sample(3000, key=jax.random.key(0))):
        cells = np.rint(np.asarray(grid.to_cells(poses.translation))).astype(int)
        assert np.asarray(grid.free)[cells[:, 1], cells[:, 0]].mean() > 0.99  # but for rounding at the edges of cells
        counts = np.unique(cells, axis=0, return_counts=True)[1]
        assert len(counts) >= 0.99 * len(space.cells)
        headings = np.histogram(np.arctan2(poses.rotation.sin, poses.rotation.cos), 8, (-np.pi, np.pi))[0]
        assert headings.min() > 3000 / 8 * 0.8
    even = np.unique(
        np.asarray(space.sample_evenly(len(space.cells), key=jax.random.key(1)).translation // 1e-9), axis=0
    )
    assert len(even) == len(space.cells)


def test_no_free_cell_is_an_error():
    with pytest.raises(ValueError, match="no free cell"):
        OccupancyMap(jnp.ones((3, 3)), 0.1, SE2.identity()).free_space()
