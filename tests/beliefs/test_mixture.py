"""Mixtures of normals against SciPy, and of poses against what they must keep."""  # T-45

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

import jaxloc as jl


@pytest.fixture
def parts(rng):
    roots = rng.normal(size=(4, 2, 2))
    weights = np.array([0.5, 0.0, 1.0, 0.25])
    return weights, rng.normal(scale=2.0, size=(4, 2)), roots @ roots.swapaxes(-1, -2) + 0.1 * np.eye(2)


def test_intensity_and_moments_are_scipys(parts, dtype):
    weights, means, covariances = parts
    mixture = jl.beliefs.Mixture(*(jnp.asarray(part, dtype) for part in parts))
    tolerance = 1e-5 if dtype == np.float32 else 1e-11
    x = np.array([0.3, -0.7])
    terms = [w * multivariate_normal.pdf(x, m, P) for w, m, P in zip(*parts, strict=True)]
    found = mixture.log_intensity(jnp.asarray(x, dtype))
    assert found.dtype == dtype and float(found) == pytest.approx(np.log(sum(terms)), abs=10 * tolerance)
    assert float(mixture.mass) == pytest.approx(1.75)
    assert mixture.valid.tolist() == [True, False, True, True]

    share = weights / weights.sum()
    mean = share @ means
    expected = sum(s * (P + np.outer(m - mean, m - mean)) for s, m, P in zip(share, means, covariances, strict=True))
    whole = mixture.gaussian()
    assert whole.mean.dtype == dtype
    np.testing.assert_allclose(whole.mean, mean, atol=10 * tolerance)
    np.testing.assert_allclose(whole.covariance, expected, atol=10 * tolerance)
    roots = np.asarray(mixture.roots())
    np.testing.assert_allclose(roots @ roots.swapaxes(-1, -2), covariances, atol=10 * tolerance)


def test_components_are_chosen_joined_and_scaled(parts):
    mixture = jl.beliefs.Mixture(*(jnp.asarray(part, jnp.float32) for part in parts), jnp.arange(4, dtype=jnp.int32))
    some = mixture.take(jnp.array([2, 0]))
    assert some.labels.tolist() == [2, 0] and some.weights.tolist() == [1.0, 0.5]
    both = mixture.concatenate(some.scaled(2.0))
    assert both.capacity == 6 and float(both.mass) == pytest.approx(4.75)
    padded = mixture.padded(7)
    assert padded.capacity == 7 and int(padded.valid.sum()) == 3 and float(padded.mass) == pytest.approx(1.75)
    x = jnp.ones(2)
    assert float(padded.log_intensity(x)) == pytest.approx(float(mixture.log_intensity(x)), abs=1e-6)
    assert mixture.padded(2).capacity == 4


def test_an_empty_mixture_is_nothing_without_nonfinite_values():
    empty = jl.beliefs.Mixture.empty(3, jnp.zeros(2))
    assert float(empty.mass) == 0.0 and float(empty.log_intensity(jnp.zeros(2))) == -np.inf
    assert bool(jnp.all(jnp.isfinite(empty.gaussian().covariance)))
    poses = jl.beliefs.Mixture.empty(3, jl.poses.SE2(0.0, 0.0, 0.0))
    assert poses.covariances.shape == (3, 3, 3) and poses.means.translation.shape == (3, 2)


@pytest.mark.usefixtures("x64")
def test_poses_average_on_their_group():
    """Headings on both sides of the cut have a mean there, and zero mean deviation from it."""
    headings = np.array([np.pi - 0.3, -np.pi + 0.2, np.pi - 0.1])
    weights = np.array([0.2, 0.5, 0.3])
    poses = jax.vmap(jl.poses.SE2)(jnp.array([0.0, 1.0, 2.0]), jnp.zeros(3), jnp.asarray(headings))
    mixture = jl.beliefs.Mixture(jnp.asarray(weights), poses, jnp.stack([0.01 * jnp.eye(3)] * 3))
    whole = mixture.gaussian()
    apart = jax.vmap(lambda pose: jl.poses.local(whole.mean, pose))(poses)
    np.testing.assert_allclose(weights @ np.asarray(apart), 0.0, atol=1e-6)
    expected = 0.01 * np.eye(3) + np.asarray(apart).T @ (weights[:, None] * np.asarray(apart))
    np.testing.assert_allclose(whole.covariance, expected, atol=1e-6)


@pytest.mark.usefixtures("x64")
def test_gradient_of_intensity_is_that_of_finite_differences(parts):
    x = jnp.array([0.3, -0.7])

    def value(weights, means):
        return jl.beliefs.Mixture(weights, means, jnp.asarray(parts[2])).log_intensity(x)

    weights, means = jnp.asarray(parts[0]), jnp.asarray(parts[1])
    by_weights, by_means = jax.grad(value, argnums=(0, 1))(weights, means)
    assert bool(jnp.all(jnp.isfinite(by_weights))) and bool(jnp.all(jnp.isfinite(by_means)))
    for k in (0, 2):
        step = 1e-6 * jnp.eye(4)[k]
        numeric = (value(weights + step, means) - value(weights - step, means)) / 2e-6
        assert float(by_weights[k]) == pytest.approx(float(numeric), rel=1e-5)
        step = step[:, None] * jnp.array([[1.0, 0.0]])
        numeric = (value(weights, means + step) - value(weights, means - step)) / 2e-6
        assert float(by_means[k, 0]) == pytest.approx(float(numeric), rel=1e-5)


@pytest.mark.parametrize(
    ("weights", "covariance", "match"),
    [
        ([0.5, -0.1], [[1.0, 0.0], [0.0, 1.0]], "never negative; got -0.1"),
        ([0.5, np.nan], [[1.0, 0.0], [0.0, 1.0]], "non-finite"),
        ([0.5, 0.1], [[1.0, 2.0], [2.0, 1.0]], "Covariance 1 .*negative eigenvalue -1"),
    ],
)
def test_numbers_without_sense_are_refused_at_the_edge(weights, covariance, match):
    covariances = jnp.stack([jnp.eye(2), jnp.array(covariance)])
    bad = jl.beliefs.Mixture(jnp.array(weights), jnp.zeros((2, 2)), covariances)
    with pytest.raises(ValueError, match=match):
        bad.check()
    assert jax.jit(lambda mixture: mixture.check().mass)(bad).shape == ()
    assert jl.beliefs.Mixture.empty(0, jnp.zeros(2)).check().capacity == 0
