"""T-56, T-90: NEES and NIS, their bounds, coverage and distribution, against scipy's chi-square distribution."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2, kstest

from jaxloc.evaluation import consistency
from jaxloc.poses import SE3, Trajectory


def random_covariances(rng, count, size):
    roots = rng.standard_normal((count, size, size))
    return roots @ np.swapaxes(roots, 1, 2) + 0.1 * np.eye(size)


def test_nees_is_the_quadratic_form(rng, dtype):
    covariances, errors = random_covariances(rng, 20, 4), rng.standard_normal((20, 4))
    squared = jax.vmap(consistency.nees)(jnp.asarray(errors), jnp.asarray(covariances))
    expected = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(covariances), errors)
    assert squared.values.dtype == dtype and bool(squared.ok.all())
    np.testing.assert_allclose(squared.values, expected, rtol=1e-3 if dtype == np.float32 else 1e-9)
    same = jax.vmap(consistency.nis)(jnp.asarray(errors), jnp.asarray(covariances))
    np.testing.assert_allclose(same.values, squared.values)


@pytest.mark.parametrize("bad", [np.zeros((2, 2)), -np.eye(2), np.full((2, 2), np.nan), 1.0 - 2.0 * np.eye(2)])
def test_bad_covariances_are_flagged_with_finite_values_and_gradients(bad, x64):
    def value(error, covariance):
        return consistency.nees(error, covariance).values

    squared = consistency.nees(jnp.ones(2), jnp.asarray(bad))
    assert not bool(squared.ok) and float(squared.values) == 0.0
    for gradient in jax.grad(value, argnums=(0, 1))(jnp.ones(2), jnp.asarray(bad)):
        assert bool(jnp.all(jnp.isfinite(gradient)))
    assert not bool(consistency.nees(jnp.array([jnp.inf, 0.0]), jnp.eye(2)).ok)


def test_the_gradient_of_nees_is_right(rng, x64):
    error, covariance = jnp.asarray(rng.standard_normal(3)), jnp.asarray(random_covariances(rng, 1, 3)[0])
    gradient = jax.grad(lambda e: consistency.nees(e, covariance).values)(error)
    np.testing.assert_allclose(gradient, 2.0 * np.linalg.solve(covariance, error), rtol=1e-9)
    change = jnp.asarray(random_covariances(rng, 1, 3)[0])
    slope = jax.jvp(lambda c: consistency.nees(error, c).values, (covariance,), (change,))[1]
    solved = np.linalg.solve(covariance, error)
    assert float(slope) == pytest.approx(float(-solved @ change @ solved), rel=1e-9)


def test_consistent_poses_lie_in_their_bounds(x64):
    """A thousand poses disturbed by their own covariance, in the right tangent space."""
    count = 1000
    keys = jax.random.split(jax.random.key(0), 2)
    truth = jax.vmap(SE3.exp)(jax.random.normal(keys[0], (count, 6)))
    root = jnp.asarray(np.linalg.cholesky(0.01 * random_covariances(np.random.default_rng(1), 1, 6)[0]))
    noise = jax.random.normal(keys[1], (count, 6)) @ root.T
    # The estimate is such that the truth is estimate @ exp(noise).
    estimate = jax.vmap(lambda pose, d: pose.retract(d).inverse().inverse())(truth, jnp.zeros_like(noise))
    estimate = jax.vmap(lambda pose, d: pose @ SE3.exp(d).inverse())(estimate, noise)
    times = jnp.arange(float(count))
    covariances = jnp.broadcast_to(root @ root.T, (count, 6, 6))
    squared = consistency.trajectory_nees(Trajectory(times, estimate), covariances, Trajectory(times, truth))
    bounds = consistency.mean_bounds(6, count, confidence=0.99)
    assert float(bounds.lower) < float(squared.values.mean()) < float(bounds.upper)
    np.testing.assert_allclose(consistency.coverage(squared, 6), [0.5, 0.9, 0.95], atol=0.04)
    # An estimator that believes itself twice as good as it is is found out.
    proud = consistency.trajectory_nees(Trajectory(times, estimate), 0.25 * covariances, Trajectory(times, truth))
    assert float(proud.values.mean()) > float(bounds.upper)
    assert float(consistency.coverage(proud, 6)[2]) < 0.7


def test_bounds_are_scipys(dtype):
    for dof, count in ((1, 1), (3, 200), (6, 600)):
        bounds = consistency.mean_bounds(dof, count, confidence=0.95)
        assert bounds.lower.dtype == dtype
        expected = chi2.ppf([0.025, 0.975], dof * count) / count
        np.testing.assert_allclose([bounds.lower, bounds.upper], expected, rtol=2e-3 if dtype == np.float32 else 1e-7)


def test_values_that_are_not_ok_do_not_count():
    values = consistency.SquaredErrors(jnp.array([0.0, 0.1, 100.0]), jnp.array([False, True, True]))
    np.testing.assert_allclose(consistency.coverage(values, 2, probabilities=(0.5,)), [0.5])
    none = consistency.SquaredErrors(jnp.zeros(3), jnp.zeros(3, bool))
    np.testing.assert_allclose(consistency.coverage(none, 2), np.zeros(3))


def test_the_distribution_of_squared_errors_is_scipys(rng, dtype):
    values = chi2.rvs(3, size=400, random_state=rng).astype(dtype)
    ok = rng.uniform(size=400) < 0.9
    fit = consistency.calibration(consistency.SquaredErrors(jnp.asarray(values), jnp.asarray(ok)), 3)
    tolerance = 1e-4 if dtype == np.float32 else 1e-9
    assert fit.distance.dtype == dtype and int(fit.count) == ok.sum()
    assert float(fit.distance) == pytest.approx(kstest(values[ok], chi2(3).cdf).statistic, abs=tolerance)
    counts, _ = np.histogram(values[ok], np.asarray(fit.edges))
    width = chi2.ppf(0.999, 3) / 20
    np.testing.assert_allclose(fit.density, counts / (ok.sum() * width), rtol=1e-3, atol=tolerance)
    np.testing.assert_allclose(fit.expected, np.diff(chi2.cdf(fit.edges, 3)) / width, atol=10 * tolerance)
    np.testing.assert_allclose(fit.coverage, [np.mean(values[ok] <= chi2.ppf(p, 3)) for p in (0.5, 0.9, 0.95)])
    proud = consistency.calibration(consistency.SquaredErrors(jnp.asarray(4.0 * values), jnp.asarray(ok)), 3)
    assert float(proud.distance) > 0.4 > 0.1 > float(fit.distance)


def test_a_distribution_of_nothing():
    fit = consistency.calibration(consistency.SquaredErrors(jnp.zeros(3), jnp.zeros(3, bool)), 3, num_bins=4)
    assert float(fit.distance) == 1.0 and int(fit.count) == 0 and fit.density.tolist() == [0.0] * 4
