"""Clutter densities against what they must integrate to."""  # T-77

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxloc as jl


def test_uniform_clutter(dtype):
    clutter = jl.tracking.UniformClutter(jnp.asarray(3.0, dtype), 40.0)
    z = jnp.zeros(2, dtype)
    assert clutter.log_density(z).dtype == dtype
    assert float(jnp.exp(clutter.log_density(z))) == pytest.approx(1 / 40.0, rel=1e-5)
    assert float(jnp.exp(clutter.log_intensity(z))) == pytest.approx(3 / 40.0, rel=1e-5)


WIDTH, HEIGHT, NEAREST, FOCAL, BASELINE = 640.0, 480.0, 2.0, 400.0, 0.5


@pytest.fixture
def frustum():
    camera = jl.sensors.Pinhole(FOCAL, FOCAL, 320.0, 240.0)
    return jl.tracking.FrustumClutter(5.0, jl.sensors.StereoRig(camera, BASELINE), WIDTH, HEIGHT, NEAREST)


def test_frustum_clutter_integrates_to_one(frustum):
    """Over what both cameras see down to the nearest depth; what is beyond the far end is known in closed form."""
    rng, far = np.random.default_rng(0), 40.0
    depth = rng.uniform(NEAREST, far, 400_000)
    u, v = rng.uniform(0.0, WIDTH, depth.size), rng.uniform(0.0, HEIGHT, depth.size)
    points = np.stack([(u - 320.0) * depth / FOCAL, (v - 240.0) * depth / FOCAL, depth], axis=1)
    density = np.asarray(jax.vmap(lambda p: jnp.exp(frustum.log_density(p)))(jnp.asarray(points, jnp.float32)))
    area = WIDTH * HEIGHT * (depth / FOCAL) ** 2  # of a slice at each depth
    integral = np.mean(density * area) * (far - NEAREST)
    # Disparities between zero and that of the far end are left out.
    assert integral == pytest.approx(1.0 - NEAREST / far, abs=0.01)


def test_frustum_clutter_is_thin_far_away(frustum):
    near, far = (float(frustum.log_density(jnp.array([0.0, 0.0, depth]))) for depth in (5.0, 10.0))
    # |dh/dp| = f^3 b / z^4
    assert near - far == pytest.approx(4 * np.log(2.0), abs=1e-4)
    volume = WIDTH * HEIGHT * FOCAL * BASELINE / NEAREST
    assert near == pytest.approx(np.log(FOCAL**3 * BASELINE / 5.0**4 / volume), abs=1e-4)
    assert float(frustum.log_intensity(jnp.array([0.0, 0.0, 5.0]))) == pytest.approx(near + np.log(5.0), abs=1e-4)


def test_behind_the_camera_there_is_none_and_a_finite_gradient(frustum):
    behind = jnp.array([0.0, 0.0, -3.0])
    assert float(frustum.log_density(behind)) == -np.inf
    slope = jax.grad(lambda p: jnp.exp(frustum.log_density(p)))
    assert bool(jnp.all(jnp.isfinite(slope(behind)))) and bool(jnp.all(jnp.isfinite(slope(jnp.zeros(3)))))
