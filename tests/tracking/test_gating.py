"""All pairs of targets and measurements against SciPy and a Kalman filter's single update."""  # T-58, T-85

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2, multivariate_normal

import jaxloc as jl
from jaxloc.tracking import gating

H = np.eye(2, 4)


@pytest.fixture
def scene(rng):
    roots = np.tril(rng.normal(size=(3, 4, 4))) + 2.0 * np.eye(4)
    return rng.normal(scale=2.0, size=(3, 4)), roots, rng.normal(scale=3.0, size=(5, 2))


def make_filter(dtype):
    motion = jl.filters.LinearMotion(jnp.eye(4, dtype=dtype), jnp.eye(4, dtype=dtype))
    return jl.filters.KalmanFilter(motion, jl.filters.LinearSensor(jnp.eye(2, 4, dtype=dtype), jnp.eye(2, dtype=dtype)))


@eqx.filter_jit
def compare(filt, means, roots, z, valid, gate):
    found = gating.compare(filt, means, roots, z, valid, gate)
    pairs = jax.vmap(lambda i: jax.vmap(lambda j: gating.corrected(means, found, i, j))(jnp.arange(5)))(jnp.arange(3))
    return found, found.innovation_covariances(), found.rest(), pairs


def test_pairs_are_scipys(scene, dtype):
    means, roots, z = scene
    valid = np.array([True, True, False, True, True])
    filt = make_filter(dtype)
    args = [jnp.asarray(part, dtype) for part in scene]
    found, covariances, rest, pairs = compare(filt, *args, jnp.asarray(valid), 0.9)
    tolerance = 2e-4 if dtype == np.float32 else 1e-9
    assert found.log_likelihood.dtype == dtype
    for i in range(3):
        P = roots[i] @ roots[i].T
        S = H @ P @ H.T + np.eye(2)
        K = P @ H.T @ np.linalg.inv(S)
        np.testing.assert_allclose(covariances[i], S, atol=20 * tolerance)
        np.testing.assert_allclose(rest[i] @ rest[i].T, P - K @ S @ K.T, atol=20 * tolerance)
        for j in np.flatnonzero(valid):
            delta = z[j] - H @ means[i]
            squared = delta @ np.linalg.solve(S, delta)
            assert float(found.squared[i, j]) == pytest.approx(squared, abs=tolerance)
            assert bool(found.inside[i, j]) == (squared <= chi2.ppf(0.9, 2))
            log = multivariate_normal.logpdf(z[j], H @ means[i], S) if found.inside[i, j] else -np.inf
            assert float(found.log_likelihood[i, j]) == pytest.approx(log, abs=tolerance)
            np.testing.assert_allclose(pairs[0][i, j], means[i] + K @ delta, atol=20 * tolerance)
            np.testing.assert_allclose(pairs[1][i, j] @ pairs[1][i, j].T, P - K @ S @ K.T, atol=20 * tolerance)
    assert not bool(jnp.any(found.inside[:, 2])) and bool(jnp.all(found.log_likelihood[:, 2] == -jnp.inf))


def test_measurements_with_nonfinite_values_count_as_absent():
    z = (jnp.array([[0.0, 1.0], [jnp.nan, 0.0], [2.0, jnp.inf]]), jnp.array([1.0, 2.0, 3.0]), jnp.array([1, 2, 3]))
    assert gating.usable_measurements(z, jnp.array([True, True, True])).tolist() == [True, False, False]
    assert gating.usable_measurements(z, jnp.array([False, True, True])).tolist() == [False, False, False]
    assert gating.usable_measurements(jnp.zeros((0, 2)), jnp.zeros(0, bool)).shape == (0,)


def test_there_is_room_for_one_at_least():
    z, valid = gating.at_least_one((jnp.zeros((0, 2)), jnp.zeros((0,), jnp.int32)), jnp.zeros(0, bool))
    assert z[0].shape == (1, 2) and z[1].dtype == jnp.int32 and valid.tolist() == [False]
    given = jnp.ones((2, 2)), jnp.array([True, False])
    assert gating.at_least_one(*given)[0] is given[0]


def test_bearings_wrap():
    """A target behind the sensor: bearings on both sides of the cut are close."""
    deviations = jnp.array([1.0, 0.05])
    sensor = jl.data.simulate.targets.PositionSensor(deviations)
    filt = jl.filters.ExtendedKalmanFilter(jl.filters.LinearMotion(jnp.eye(2), jnp.eye(2)), sensor)
    z = jax.vmap(lambda angle: jl.sensors.RangeBearing(jnp.array(10.0), jl.poses.SO2.from_angle(angle), jnp.array(0)))(
        jnp.array([np.pi - 0.01, -np.pi + 0.01])
    )
    found = gating.compare(filt, jnp.array([[-10.0, 0.0]]), 0.1 * jnp.eye(2)[None], z, jnp.ones(2, bool), 0.99)
    assert bool(jnp.all(found.inside))
    np.testing.assert_allclose(found.squared[0, 0], found.squared[0, 1], atol=1e-4)
