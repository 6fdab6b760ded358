"""Laser models beside NumPy: likelihood fields, ray casting, densities that sum to one. Inventory: R-11."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, ndimage

from jaxloc.data.simulate.laser import cast_rays
from jaxloc.poses import SE2, retract
from jaxloc.sensors import BeamModel, DistanceField, LaserScan, LikelihoodField, OccupancyMap
from jaxloc.sensors.beam_model import trace

BOXES = np.array([[0, 0, 6, 0.2], [0, 3.8, 6, 4], [0, 0, 0.2, 4], [5.8, 0, 6, 4], [2, 1, 2.6, 1.6]], float)
RESOLUTION = 0.05


def make_map(dtype=jnp.float32):
    centers_x, centers_y = (np.arange(120) + 0.5) * RESOLUTION, (np.arange(80) + 0.5) * RESOLUTION
    grid = np.zeros((80, 120))
    for low_x, low_y, high_x, high_y in BOXES:
        rows, columns = (centers_y > low_y) & (centers_y < high_y), (centers_x > low_x) & (centers_x < high_x)
        grid[np.ix_(rows, columns)] = 1.0
    return OccupancyMap(jnp.asarray(grid, dtype), RESOLUTION, SE2.identity(dtype))


@functools.cache
def make_field(dtype=jnp.float32, ceiling=2.0):
    return DistanceField.of(make_map(dtype), ceiling=jnp.asarray(ceiling, dtype))


def pose_of(values, dtype=jnp.float32):
    return SE2(*(jnp.asarray(value, dtype) for value in values))


def test_thinned_scans_keep_their_directions():
    scan = LaserScan(jnp.arange(180.0), -0.5 * np.pi, np.pi / 180)
    thin = scan.thin(60)
    assert thin.ranges.shape == (60,)
    np.testing.assert_allclose(thin.angles, scan.angles[1::3], atol=1e-6)
    assert scan.thin(1000).ranges.shape == (180,) and scan.thin(1).ranges.tolist() == [90.0]
    stack = LaserScan(jnp.zeros((4, 180)), 0.0, 0.1).thin(7)
    assert stack.ranges.shape == (4, 7)
    with pytest.raises(ValueError, match="at least one"):
        scan.thin(0)


def test_likelihood_field_is_that_of_numpy(rng, dtype):
    mount = pose_of((0.2, -0.1, 0.3), dtype)
    sensor = LikelihoodField(make_field(dtype, 10.0), mount, sigma=0.15, z_hit=0.8, max_range=6.0)
    pose = np.array([3.0, 2.0, 0.4])
    angles = -1.0 + 0.1 * np.arange(20)
    ranges = np.where(rng.uniform(size=20) < 0.8, rng.uniform(0.3, 2.0, 20), rng.uniform(2.0, 7.0, 20))
    ranges[:3] = np.nan, -1.0, np.inf
    scan = LaserScan(jnp.asarray(ranges, dtype), -1.0, 0.1)
    valid = np.ones(20, bool)
    valid[5] = False
    value = sensor.log_prob(pose_of(pose, dtype), scan, jnp.asarray(valid))
    assert value.dtype == dtype

    use = valid & np.isfinite(ranges) & (np.nan_to_num(ranges) > 0) & (np.nan_to_num(ranges) < 6.0)
    ranges = np.where(use, ranges, 1.0)
    x = 0.2 + ranges * np.cos(angles + 0.3)
    y = -0.1 + ranges * np.sin(angles + 0.3)
    world_x = 3.0 + np.cos(0.4) * x - np.sin(0.4) * y
    world_y = 2.0 + np.sin(0.4) * x + np.cos(0.4) * y
    distance = RESOLUTION * ndimage.distance_transform_edt(np.asarray(make_map().probability) == 0.0)
    grid = np.stack([world_y, world_x])[:, use] / RESOLUTION - 0.5
    inside = (grid[0] > 0) & (grid[0] < 79) & (grid[1] > 0) & (grid[1] < 119)
    assert inside.sum() > 8
    d = ndimage.map_coordinates(distance, grid, order=1, mode="nearest")
    # A point outside lies beyond the outer wall: as far from it as from the border's cell centers.
    overshoot = np.hypot(*(grid - np.clip(grid, 0, [[79], [119]]))) * RESOLUTION
    d = np.minimum(d + overshoot, 10.0)
    density = 0.8 * np.exp(-0.5 * (d / 0.15) ** 2) / (0.15 * np.sqrt(2 * np.pi)) + 0.2 / 6.0
    assert float(value) == pytest.approx(np.log(density).sum(), rel=2e-4)
    # Beams that are worth ten.
    worth = LikelihoodField(sensor.field, mount, sigma=0.15, z_hit=0.8, max_range=6.0, independent_beams=4.0)
    again = worth.log_prob(pose_of(pose, dtype), scan, jnp.asarray(valid))
    assert float(again) == pytest.approx(float(value) * 4.0 / use.sum(), rel=1e-5)


@pytest.mark.parametrize("make", [LikelihoodField, BeamModel])
def test_masked_beams_are_as_if_absent_and_scans_without_beams_say_nothing(make):
    sensor = make(make_field(), max_range=6.0)
    pose = pose_of((3.0, 2.5, 0.4))
    bad = LaserScan(jnp.array([1.0, jnp.nan, 2.0, -jnp.inf, 0.0]), 0.0, 0.1)
    mask = jnp.array([True, True, False, True, True])
    alone = sensor.log_prob(pose, LaserScan(jnp.array([1.0]), 0.0, 0.1), jnp.array(True))
    function = jax.jit(jax.value_and_grad(lambda d, mask: sensor.log_prob(retract(pose, d), bad, mask)))
    value, slope = function(jnp.zeros(3), mask)
    assert float(value) == pytest.approx(float(alone), abs=1e-5) and np.isfinite(slope).all()
    nothing, slope = function(jnp.zeros(3), jnp.zeros(5, bool))
    assert float(nothing) == 0.0 and not np.any(slope)


def test_traced_rays_meet_the_walls(rng):
    field = make_field(ceiling=5.0)
    poses = np.array([[3.0, 2.0, 0.1], [1.0, 3.0, -2.0], [4.0, 0.7, 1.0]])
    angles = np.linspace(-np.pi, np.pi, 73)
    expected = cast_rays(BOXES, poses, angles, 20.0)
    function = jax.jit(
        jax.vmap(lambda p: trace(field, SE2(p[0], p[1], p[2]), jnp.asarray(angles, jnp.float32), max_range=20.0))
    )
    error = np.abs(np.asarray(function(jnp.asarray(poses, jnp.float32))) - expected)
    # Half a cell where rays meet walls; more where they graze a corner, which a grid does not show exactly.
    assert np.median(error) < 0.02 and np.percentile(error, 95) < 0.08


def test_rays_that_hit_nothing_end_at_the_greatest_range():
    field = DistanceField.of(OccupancyMap(jnp.zeros((9, 9)).at[0, 0].set(1.0), 0.1, SE2.identity()), ceiling=5.0)
    ranges = trace(field, pose_of((0.5, 0.5, 0.0)), jnp.array([0.0, 1.0]), max_range=4.0)
    assert ranges.tolist() == [4.0, 4.0]
    inside = trace(field, pose_of((0.05, 0.05, 0.0)), jnp.array([0.0]), max_range=4.0)
    assert inside.tolist() == [0.0]


def test_expected_ranges_have_the_derivatives_of_the_walls(x64):
    # Facing a flat wall at 30 degrees: d range / d x = -1 / cos for the beam, and so on.
    field = make_field(jnp.float64, ceiling=5.0)
    sensor = BeamModel(field)
    angle = jnp.pi / 6
    scan = LaserScan(jnp.ones(1), 0.0, 0.1)
    pose = SE2(jnp.asarray(4.0), 2.0, angle)
    expected, jacobian = jax.jit(lambda pose: sensor.linearize(pose, scan))(pose)
    length = (5.8 - 4.0) / np.cos(angle)
    assert float(expected.ranges[0]) == pytest.approx(length, abs=2e-3)
    # Right tangent: forward shortens the range by one; sideways by tan; turning by range times tan.
    np.testing.assert_allclose(jacobian[0], [-1.0, np.tan(angle), length * np.tan(angle)], atol=2e-2)


def test_the_gradient_is_that_of_differences(x64):
    field = make_field(jnp.float64, ceiling=5.0)
    pose = SE2(jnp.asarray(3.3), 2.41, 0.17)
    scan = LaserScan(jnp.asarray([1.4, 1.2, 2.2, 1.0]), -1.0, 0.7)
    sensor = LikelihoodField(field, sigma=0.4, max_range=9.0)

    @jax.jit
    def value(delta):
        return sensor.log_prob(retract(pose, delta), scan, jnp.array(True))

    slopes = [(value(1e-6 * e) - value(-1e-6 * e)) / 2e-6 for e in jnp.eye(3)]
    np.testing.assert_allclose(jax.grad(value)(jnp.zeros(3)), slopes, rtol=1e-5)


def test_the_beam_density_sums_to_one():
    sensor = BeamModel(make_field(ceiling=5.0), max_range=5.0, sigma=0.05)
    pose = pose_of((3.0, 2.0, 0.0))

    @jax.jit
    @jax.vmap
    def density(reading):
        return jnp.exp(sensor.log_prob(pose, LaserScan(reading[None], 0.0, 0.1), jnp.array(True)))

    readings = np.linspace(0.0015, 4.9999, 20_001)
    below = integrate.simpson(np.asarray(density(jnp.asarray(readings, jnp.float32))), x=readings)
    at_limit = float(density(jnp.array([5.0]))[0])
    assert below + at_limit == pytest.approx(1.0, abs=5e-3)
    assert at_limit == pytest.approx(0.05, abs=1e-3)
    near, wall, beyond = density(jnp.array([1.0, 2.8, 4.0]))
    assert wall > 4 and near > beyond
