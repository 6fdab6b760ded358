import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.multiview.stereo_triangulation import Linear, Sampled, Unscented, coverage, stereo_jacobian, triangulate
from jaxloc.sensors import Pinhole, StereoRig

FOCAL, FOCAL_BASELINE = 718.856, 387.57


def kitti(baseline=FOCAL_BASELINE / FOCAL, fy=FOCAL, skew=0.0):
    return StereoRig(Pinhole(FOCAL, fy, 607.19, 185.2, skew), baseline)


def at(z, dtype):
    return jnp.asarray([[0.1 * z, 0.05 * z, z]], dtype)


def test_depth_error_of_the_thesis(dtype):  # T-7, T-72
    rig, noise = kitti(), 0.25 * jnp.eye(3, dtype=dtype)
    for z, expected in ((10, 0.18), (20, 0.73), (30, 1.64), (50, 4.56)):
        point = triangulate(rig, rig.project(at(z, dtype))[0], noise)
        assert point.covariance.dtype == dtype
        assert abs(float(jnp.sqrt(point.covariance[2, 2])) - expected) < 0.006


def test_depth_error_grows_with_range_and_falls_with_baseline(x64):  # T-7
    noise = 0.25 * jnp.eye(3)

    def sigma(z, baseline):
        rig = kitti(baseline)
        measurement = rig.project(jnp.stack([jnp.zeros_like(z), jnp.zeros_like(z), z])[None])[0]
        return jnp.sqrt(triangulate(rig, measurement, noise).covariance[2, 2])

    z, baseline = jnp.geomspace(3.0, 60.0, 12), jnp.geomspace(0.05, 2.0, 12)
    by_range = jax.vmap(lambda z: sigma(z, jnp.asarray(0.5)))(z)
    by_baseline = jax.vmap(lambda b: sigma(jnp.asarray(20.0), b))(baseline)
    assert np.isclose(np.polyfit(np.log(z), np.log(by_range), 1)[0], 2.0, atol=1e-9)
    assert np.isclose(np.polyfit(np.log(baseline), np.log(by_baseline), 1)[0], -1.0, atol=1e-9)


def test_jacobian_of_the_thesis(x64):  # T-72
    rig, (u_left, u_right, v) = kitti(), (640.0, 610.0, 200.0)
    d, B, f, cx, cy = u_left - u_right, FOCAL_BASELINE / FOCAL, FOCAL, 607.19, 185.2
    expected = [
        [-B * (u_right - cx) / d**2, B * (u_left - cx) / d**2, 0.0],
        [-B * (v - cy) / d**2, B * (v - cy) / d**2, B / d],
        [-f * B / d**2, f * B / d**2, 0.0],
    ]
    assert np.allclose(stereo_jacobian(rig, jnp.array([u_left, u_right, v])), expected, rtol=1e-12)


@pytest.mark.parametrize("skew", [0.0, 5.0])
def test_jacobian_equals_differences(x64, skew):
    rig, measurement = kitti(fy=650.0, skew=skew), jnp.array([700.0, 660.0, 120.0])
    jacobian = stereo_jacobian(rig, measurement)
    for i in range(3):
        step = 1e-4 * jnp.eye(3)[i]
        ends = rig.triangulate(jnp.stack([measurement + step, measurement - step]))
        assert np.allclose(jacobian[:, i], (ends[0] - ends[1]) / 2e-4, atol=1e-8)


@pytest.mark.parametrize("method", [Linear(), Unscented(), Sampled(20000)])
def test_near_covariance_equals_monte_carlo(x64, rng, method):  # T-72
    rig, noise = kitti(), jnp.diag(jnp.array([0.3, 0.3, 0.2]) ** 2)
    measurement = rig.project(at(12.0, np.float64))[0]
    point = triangulate(rig, measurement, noise, method=method, key=jax.random.key(0))
    u_left, u_right, v = rng.multivariate_normal(measurement, noise, 100000).T
    z = FOCAL_BASELINE / (u_left - u_right)
    draws = np.stack([z * (u_left - 607.19) / FOCAL, z * (v - 185.2) / FOCAL, z])
    assert np.allclose(point.mean, draws.mean(1), atol=0.01)
    assert np.linalg.norm(point.covariance - np.cov(draws)) < 0.03 * np.linalg.norm(np.cov(draws))


def test_unscented_is_closer_in_depth_at_long_range(x64, rng):  # T-73
    rig, noise = kitti(), 0.25 * jnp.eye(3)
    measurement = rig.project(at(80.0, np.float64))[0]
    depth = FOCAL_BASELINE / (FOCAL_BASELINE / 80.0 + 0.5 * 2**0.5 * rng.normal(size=400000))
    linear, unscented = (triangulate(rig, measurement, noise, method=m) for m in (Linear(), Unscented()))
    assert abs(unscented.mean[2] - depth.mean()) < 0.2 * abs(linear.mean[2] - depth.mean())
    errors = [abs(jnp.sqrt(p.covariance[2, 2]) - depth.std()) for p in (unscented, linear)]
    assert errors[0] < 0.7 * errors[1]


def test_coverage_of_the_methods_over_range(x64):  # T-73
    rig, noise = kitti(), 0.25 * jnp.eye(3)
    ranges = jnp.array([10.0, 100.0])

    def held(method):
        def one(z):
            point = jnp.stack([0.1 * z, 0.05 * z, z])
            return coverage(rig, point, noise, key=jax.random.key(0), method=method, num_trials=8000)

        return np.asarray(jax.vmap(one)(ranges))

    linear, unscented, sampled = held(Linear()), held(Unscented()), held(Sampled(64))
    standard_error = (0.95 * 0.05 / 8000) ** 0.5
    assert abs(linear[0] - 0.95) < 4 * standard_error and abs(unscented[0] - 0.95) < 4 * standard_error
    assert linear[1] < 0.95 - 8 * standard_error  # the claimed ellipsoid is too small far away
    assert linear[1] + 4 * standard_error < unscented[1]
    # 64 samples estimate the covariance coarsely: their ellipsoid is a little too small near by, too.
    assert 0.92 < sampled[0] < 0.95 and linear[1] < sampled[1]


def test_gradient_vmap_and_eager(x64):
    rig, noise = kitti(), 0.25 * jnp.eye(3)
    measurements = rig.project(jnp.concatenate([at(8.0, np.float64), at(20.0, np.float64)]))
    for method in (Linear(), Unscented(), Sampled(16)):

        def total(measurement, method=method):
            point = triangulate(rig, measurement, noise, method=method, key=jax.random.key(1))
            return point.mean.sum() + point.covariance.sum()

        gradient = jax.grad(total)(measurements[0])
        for i in range(3):
            step = 1e-5 * jnp.eye(3)[i]
            difference = (total(measurements[0] + step) - total(measurements[0] - step)) / 2e-5
            assert np.isclose(gradient[i], difference, rtol=1e-5, atol=1e-7)
        assert np.allclose(jax.vmap(total)(measurements), [total(m) for m in measurements])
    with jax.disable_jit():
        eager = triangulate(rig, measurements[0], noise)
    assert np.allclose(eager.covariance, triangulate(rig, measurements[0], noise).covariance)


def test_measurements_without_depth_stay_finite(dtype):
    rig, noise = kitti(), 0.25 * jnp.eye(3, dtype=dtype)
    for measurement in ([600.0, 600.0, 100.0], [600.0, 620.0, 100.0]):
        for method in (Linear(), Unscented(), Sampled(16)):
            point, pull = jax.vjp(
                lambda m, method=method: triangulate(rig, m, noise, method=method, key=jax.random.key(0)),
                jnp.asarray(measurement, dtype),
            )
            assert all(np.isfinite(leaf).all() for leaf in (*jax.tree.leaves(point), *pull(point)))


def test_sampling_needs_a_key():
    with pytest.raises(ValueError, match="key"):
        triangulate(kitti(), jnp.array([640.0, 610.0, 200.0]), jnp.eye(3), method=Sampled())
