import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.beliefs import Gaussian, compose, invert, relative
from jaxloc.poses import SE2, SE3, local


def spd(rng, size, scale):
    a = rng.normal(size=(size, size))
    return jnp.asarray(scale * (a @ a.T + 0.1 * np.eye(size)))


def a_pose(rng, kind):
    if kind is SE2:
        x, y, theta = rng.normal(size=3)
        return SE2(jnp.asarray(x), jnp.asarray(y), jnp.asarray(theta))
    return SE3.exp(jnp.asarray(rng.normal(size=6)))


def sampled_covariance(mean, draws):
    return np.cov(np.asarray(jax.jit(jax.vmap(lambda x: local(mean, x)))(draws)).T)


@pytest.mark.parametrize("kind", [SE2, SE3])
def test_chain_agrees_with_monte_carlo_and_grows(x64, rng, kind):  # K-4
    links = [Gaussian(a_pose(rng, kind), spd(rng, kind.dof, 3e-4)) for _ in range(3)]
    product = jax.jit(jax.vmap(lambda a, b: a @ b))
    chain, draws = links[0], links[0].sample(20000, key=jax.random.key(0))
    traces = [float(jnp.trace(chain.covariance))]
    for i, link in enumerate(links[1:], 1):
        chain = compose(chain, link)
        draws = product(draws, link.sample(20000, key=jax.random.key(i)))
        traces.append(float(jnp.trace(chain.covariance)))
    expected = sampled_covariance(chain.mean, draws)
    assert np.linalg.norm(chain.covariance - expected) < 0.04 * np.linalg.norm(expected)
    assert np.all(np.diff(traces) > 0)


@pytest.mark.parametrize("kind", [SE2, SE3])
def test_invert_agrees_with_monte_carlo(x64, rng, kind):
    gaussian = Gaussian(a_pose(rng, kind), spd(rng, kind.dof, 3e-4))
    inverse = invert(gaussian)
    draws = jax.jit(jax.vmap(lambda x: x.inverse()))(gaussian.sample(20000, key=jax.random.key(0)))
    expected = sampled_covariance(inverse.mean, draws)
    assert np.linalg.norm(inverse.covariance - expected) < 0.04 * np.linalg.norm(expected)
    assert np.allclose(invert(inverse).covariance, gaussian.covariance, atol=1e-12)


def test_relative_undoes_compose(x64, rng):  # K-3
    certain = Gaussian(a_pose(rng, SE3), jnp.zeros((6, 6)))
    step = Gaussian(a_pose(rng, SE3), spd(rng, 6, 1e-3))
    back = relative(certain, compose(certain, step))
    assert np.allclose(back.mean.matrix(), step.mean.matrix()) and np.allclose(back.covariance, step.covariance)


def test_distance_is_kept_by_inversion(dtype, rng):
    gaussian = Gaussian(SE2(1.0, -2.0, 0.7), jnp.asarray(spd(rng, 3, 0.01), dtype))
    x = SE2(1.1, -2.1, 0.75)
    distance, mirrored = gaussian.mahalanobis_squared(x), invert(gaussian).mahalanobis_squared(x.inverse())
    # Equal to second order: the inverse turns right perturbations into left ones.
    assert np.isclose(distance, mirrored, rtol=2e-3)
    assert mirrored.dtype == dtype


def test_vmap_and_eager(dtype, rng):
    gaussian = Gaussian(SE2(1.0, -2.0, 0.7), jnp.asarray(spd(rng, 3, 0.01), dtype))
    stack = jax.tree.map(lambda leaf: jnp.stack([leaf, 0.5 * leaf]), gaussian)
    together = jax.vmap(lambda g: compose(g, gaussian))(stack)
    assert np.allclose(together.covariance[0], compose(gaussian, gaussian).covariance, rtol=1e-5)
    with jax.disable_jit():
        assert np.allclose(together.covariance[0], compose(gaussian, gaussian).covariance, rtol=1e-5, atol=1e-6)


def test_vectors_are_refused():
    with pytest.raises(ValueError, match="poses"):
        invert(Gaussian(jnp.zeros(2), jnp.eye(2)))
