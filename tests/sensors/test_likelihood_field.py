"""The likelihood field model against NumPy. Inventory: R-11."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage

from jaxloc.poses import SE2, retract
from jaxloc.sensors import LaserScan, LikelihoodField


def pose_of(values, dtype=jnp.float32):
    return SE2(*(jnp.asarray(value, dtype) for value in values))


def test_log_density_equals_numpy(rng, dtype, make_field, make_map):
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
    distance = 0.05 * ndimage.distance_transform_edt(np.asarray(make_map().probability) == 0.0)
    grid = np.stack([world_y, world_x])[:, use] / 0.05 - 0.5
    inside = (grid[0] > 0) & (grid[0] < 79) & (grid[1] > 0) & (grid[1] < 119)
    assert inside.sum() > 8
    d = ndimage.map_coordinates(distance, grid, order=1, mode="nearest")
    # A point outside lies beyond the outer wall: as far from it as from the border's cell centers.
    overshoot = np.hypot(*(grid - np.clip(grid, 0, [[79], [119]]))) * 0.05
    d = np.minimum(d + overshoot, 10.0)
    density = 0.8 * np.exp(-0.5 * (d / 0.15) ** 2) / (0.15 * np.sqrt(2 * np.pi)) + 0.2 / 6.0
    assert float(value) == pytest.approx(np.log(density).sum(), rel=2e-4)
    # Beams that are worth ten.
    worth = LikelihoodField(sensor.field, mount, sigma=0.15, z_hit=0.8, max_range=6.0, independent_beams=4.0)
    again = worth.log_prob(pose_of(pose, dtype), scan, jnp.asarray(valid))
    assert float(again) == pytest.approx(float(value) * 4.0 / use.sum(), rel=1e-5)


def test_gradient_equals_differences(x64, make_field):
    field = make_field(jnp.float64, ceiling=5.0)
    pose = SE2(jnp.asarray(3.3), 2.41, 0.17)
    scan = LaserScan(jnp.asarray([1.4, 1.2, 2.2, 1.0]), -1.0, 0.7)
    sensor = LikelihoodField(field, sigma=0.4, max_range=9.0)

    @jax.jit
    def value(delta):
        return sensor.log_prob(retract(pose, delta), scan, jnp.array(True))

    slopes = [(value(1e-6 * e) - value(-1e-6 * e)) / 2e-6 for e in jnp.eye(3)]
    np.testing.assert_allclose(jax.grad(value)(jnp.zeros(3)), slopes, rtol=1e-5)
