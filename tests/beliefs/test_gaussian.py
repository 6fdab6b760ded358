import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2, kstest, multivariate_normal

from jaxloc.beliefs import Gaussian, fuse
from jaxloc.poses import SE3, local, retract


def spd(rng, size, dtype, scale=1.0):
    a = rng.normal(size=(size, size))
    return jnp.asarray(scale * (a @ a.T + 0.1 * np.eye(size)), dtype)


def posed(rng, dtype):
    pose = SE3.from_euler(jnp.array([1.0, 2.0, 3.0], dtype), yaw=0.5, pitch=0.2, roll=-0.3)
    return Gaussian({"pose": pose, "velocity": jnp.array([1.0, -1.0], dtype)}, spd(rng, 8, dtype, 0.002))


def test_log_prob_equals_scipy(dtype, rng):
    mean, covariance, x = (
        jnp.asarray(rng.normal(size=4), dtype),
        spd(rng, 4, dtype),
        jnp.asarray(rng.normal(size=4), dtype),
    )
    gaussian = Gaussian(mean, covariance)
    expected = multivariate_normal.logpdf(np.float64(x), np.float64(mean), np.float64(covariance))
    tolerance = 1e-4 if dtype == np.float32 else 1e-11
    assert gaussian.log_prob(x).dtype == dtype
    assert np.isclose(gaussian.log_prob(x), expected, rtol=tolerance)
    d = np.float64(x) - np.float64(mean)
    assert np.isclose(gaussian.mahalanobis_squared(x), d @ np.linalg.solve(np.float64(covariance), d), rtol=tolerance)


def test_density_on_a_manifold(x64, rng):
    gaussian = posed(rng, np.float64)
    delta = jnp.asarray(0.05 * rng.normal(size=8))
    x = retract(gaussian.mean, delta)
    d, P = np.asarray(delta), np.asarray(gaussian.covariance)
    assert np.isclose(gaussian.mahalanobis_squared(x), d @ np.linalg.solve(P, d), rtol=1e-9)
    assert np.isclose(gaussian.log_prob(x), multivariate_normal.logpdf(d, np.zeros(8), P), rtol=1e-9)


def test_samples_have_the_density(dtype, rng):
    gaussian = posed(rng, dtype)
    draws = gaussian.sample(4000, key=jax.random.key(1))
    deltas = np.asarray(jax.jit(jax.vmap(lambda x: local(gaussian.mean, x)))(draws))
    assert np.allclose(np.cov(deltas.T), gaussian.covariance, atol=0.1 * float(gaussian.covariance.max()))
    distances = np.asarray(jax.vmap(gaussian.mahalanobis_squared)(draws))
    assert kstest(distances, chi2(8).cdf).pvalue > 1e-3


def test_gradients_equal_differences(x64, rng):
    gaussian, x = Gaussian(jnp.asarray(rng.normal(size=3)), spd(rng, 3, np.float64)), jnp.asarray(rng.normal(size=3))
    gradient = jax.grad(lambda g: g.log_prob(x))(gaussian)
    for i in range(3):
        step = 1e-6 * np.eye(3)[i]
        difference = (
            Gaussian(gaussian.mean + step, gaussian.covariance).log_prob(x)
            - Gaussian(gaussian.mean - step, gaussian.covariance).log_prob(x)
        ) / 2e-6
        assert np.isclose(gradient.mean[i], difference, rtol=1e-6)
        bump = 1e-6 * np.diag(np.eye(3)[i])
        difference = (
            Gaussian(gaussian.mean, gaussian.covariance + bump).log_prob(x)
            - Gaussian(gaussian.mean, gaussian.covariance - bump).log_prob(x)
        ) / 2e-6
        assert np.isclose(gradient.covariance[i, i], difference, rtol=1e-5)


def test_fusion_adds_information(x64, rng):  # T-2
    a, b = (Gaussian(jnp.asarray(rng.normal(size=2)), spd(rng, 2, np.float64)) for _ in range(2))
    posterior = fuse(a, b)
    information = [np.linalg.inv(g.covariance) for g in (a, b)]
    assert np.allclose(np.linalg.inv(posterior.covariance), sum(information))
    weighted = sum(i @ np.asarray(g.mean) for i, g in zip(information, (a, b), strict=True))
    assert np.allclose(posterior.mean, np.linalg.solve(sum(information), weighted))
    # The product of the densities is the posterior times a constant.
    points = jnp.asarray(rng.normal(size=(5, 2)))
    ratio = [float(a.log_prob(x) + b.log_prob(x) - posterior.log_prob(x)) for x in points]
    assert np.ptp(ratio) < 1e-9


def test_fusion_with_certainty_and_ignorance(dtype):
    sharp = Gaussian(jnp.array([1.0, 2.0], dtype), jnp.zeros((2, 2), dtype))
    vague = Gaussian(jnp.array([5.0, 5.0], dtype), 1e6 * jnp.eye(2, dtype=dtype))
    posterior = fuse(vague, sharp)
    assert np.allclose(posterior.mean, sharp.mean, atol=1e-4) and np.allclose(posterior.covariance, 0.0, atol=1e-3)
    both = fuse(sharp, sharp)
    assert np.isfinite(both.mean).all() and np.isfinite(both.covariance).all()


def test_marginal(x64, rng):
    gaussian = Gaussian(jnp.asarray(rng.normal(size=4)), spd(rng, 4, np.float64))
    part = gaussian.marginal((2, 0))
    assert np.array_equal(part.mean, gaussian.mean[np.array([2, 0])])
    assert np.array_equal(part.covariance, np.asarray(gaussian.covariance)[np.ix_([2, 0], [2, 0])])


def test_vmap_equals_loop_and_eager(dtype, rng):
    means = jnp.asarray(rng.normal(size=(5, 3)), dtype)
    covariances = jnp.stack([spd(rng, 3, dtype) for _ in range(5)])
    x = jnp.zeros(3, dtype)
    together = jax.vmap(lambda m, P: Gaussian(m, P).log_prob(x))(means, covariances)
    for i in range(5):
        assert np.isclose(Gaussian(means[i], covariances[i]).log_prob(x), together[i], rtol=1e-5)
    with jax.disable_jit():
        assert np.isclose(Gaussian(means[0], covariances[0]).log_prob(x), together[0], rtol=1e-5)


def test_degenerate_covariance_is_finite(dtype):
    gaussian = Gaussian(jnp.zeros(2, dtype), jnp.ones((2, 2), dtype))
    value, gradient = jax.value_and_grad(lambda g: g.log_prob(jnp.array([1.0, 1.0], dtype)))(gaussian)
    assert np.isfinite(value) and all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))


def test_wrong_input_is_refused(rng):
    with pytest.raises(ValueError, match="6 degrees"):
        Gaussian(SE3.identity(), jnp.eye(5))
    pose = Gaussian(SE3.identity(), jnp.eye(6))
    with pytest.raises(ValueError, match="vector"):
        fuse(pose, pose)
    with pytest.raises(ValueError, match="vector"):
        pose.marginal((0,))
