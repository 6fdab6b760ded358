"""Distance fields against SciPy's transform, and ray casting against exact intersections."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage

from jaxloc.data.simulate.laser import cast_rays
from jaxloc.poses import SE2
from jaxloc.sensors import DistanceField, OccupancyMap
from jaxloc.sensors.maps.distance_field import squared_distances, trace


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


def test_bilinear_lookup(rng, dtype, random_map):
    field = DistanceField.of(random_map(rng, dtype=dtype), ceiling=4.0)
    assert field.distance.dtype == dtype
    u, v = jnp.asarray(rng.uniform(0, 30, 50), dtype), jnp.asarray(rng.uniform(0, 22, 50), dtype)
    expected = ndimage.map_coordinates(np.asarray(field.distance, np.float64), [v, u], order=1)
    np.testing.assert_allclose(field.lookup(u, v), expected, atol=1e-5)
    np.testing.assert_allclose(field.lookup(jnp.array([30.0], dtype), jnp.array([22.0], dtype)), field.distance[22, 30])


def test_outside_the_distance_goes_on_up_to_the_ceiling(rng, random_map):
    field = DistanceField.of(random_map(rng), ceiling=4.0)
    border = field.distance[10, 30]
    values = field.lookup(jnp.array([30.0, 31.0, 32.0, 1e4]), jnp.full(4, 10.0))
    np.testing.assert_allclose(values, jnp.minimum(border + jnp.array([0.0, 0.5, 1.0, 1e9]), 4.0), rtol=1e-6)
    bad = field.at(jnp.array([[jnp.nan, 0.0], [jnp.inf, 1.0]]))
    assert bad.tolist() == [4.0, 4.0]


def test_gradients_reach_map_and_place(x64, rng, random_map):
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


def test_a_place_on_the_border_has_a_finite_gradient(rng, random_map):
    field = DistanceField.of(random_map(rng), ceiling=4.0)
    for u in (0.0, 30.0, 35.0):
        assert np.isfinite(jax.grad(lambda x: field.lookup(x, jnp.array(3.0)))(jnp.array(u)))


def test_traced_rays_meet_the_walls(rng, make_field, boxes):
    field = make_field(ceiling=5.0)
    poses = np.array([[3.0, 2.0, 0.1], [1.0, 3.0, -2.0], [4.0, 0.7, 1.0]])
    angles = np.linspace(-np.pi, np.pi, 73)
    expected = cast_rays(boxes, poses, angles, 20.0)
    function = jax.jit(
        jax.vmap(lambda p: trace(field, SE2(p[0], p[1], p[2]), jnp.asarray(angles, jnp.float32), max_range=20.0))
    )
    error = np.abs(np.asarray(function(jnp.asarray(poses, jnp.float32))) - expected)
    # Half a cell where rays meet walls; more where they graze a corner, which a grid does not show exactly.
    assert np.median(error) < 0.02 and np.percentile(error, 95) < 0.08


def test_rays_that_hit_nothing_end_at_the_largest_range():
    field = DistanceField.of(OccupancyMap(jnp.zeros((9, 9)).at[0, 0].set(1.0), 0.1, SE2.identity()), ceiling=5.0)
    ranges = trace(field, SE2(0.5, 0.5, 0.0), jnp.array([0.0, 1.0]), max_range=4.0)
    assert ranges.tolist() == [4.0, 4.0]
    inside = trace(field, SE2(0.05, 0.05, 0.0), jnp.array([0.0]), max_range=4.0)
    assert inside.tolist() == [0.0]
