"""The map that tests of laser models share: a room of 6 m by 4 m with a box in it."""

import functools

import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.poses import SE2
from jaxloc.sensors import DistanceField, OccupancyMap

BOXES = np.array([[0, 0, 6, 0.2], [0, 3.8, 6, 4], [0, 0, 0.2, 4], [5.8, 0, 6, 4], [2, 1, 2.6, 1.6]], float)
RESOLUTION = 0.05


@pytest.fixture
def boxes():
    """Obstacles as rows (low x, low y, high x, high y), m."""
    return BOXES


@pytest.fixture
def make_field():
    """A function of dtype and ceiling that gives the distance field."""
    return room_field


@functools.cache
def room_field(dtype=jnp.float32, ceiling=2.0):
    return DistanceField.of(room_map(dtype), ceiling=jnp.asarray(ceiling, dtype))


@pytest.fixture
def make_map():
    """A function of dtype that gives the map, in cells of 5 cm."""
    return room_map


def room_map(dtype=jnp.float32):
    centers_x, centers_y = (np.arange(120) + 0.5) * RESOLUTION, (np.arange(80) + 0.5) * RESOLUTION
    grid = np.zeros((80, 120))
    for low_x, low_y, high_x, high_y in BOXES:
        rows, columns = (centers_y > low_y) & (centers_y < high_y), (centers_x > low_x) & (centers_x < high_x)
        grid[np.ix_(rows, columns)] = 1.0
    return OccupancyMap(jnp.asarray(grid, dtype), RESOLUTION, SE2.identity(dtype))


def _random_map(rng, shape=(23, 31), dtype=jnp.float32, part=0.05):
    probability = (rng.uniform(size=shape) < part).astype(np.float64)
    return OccupancyMap(jnp.asarray(probability, dtype), 0.5, SE2(jnp.asarray(1.0, dtype), -2.0, 0.7))


@pytest.fixture
def random_map():
    """A function of a random generator that gives a map of random cells."""
    return _random_map
