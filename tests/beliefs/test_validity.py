"""Densities that are none, in fusion and in mixtures; which matrices are covariances."""

import jax
import jax.numpy as jnp
import numpy as np

import jaxloc as jl
from jaxloc import _tree as tree
from jaxloc.beliefs import validity


def test_fusion_with_a_density_that_is_none():
    one = jl.beliefs.Gaussian(jnp.ones(2), 2.0 * jnp.eye(2))

    @jax.jit
    @jax.vmap
    def fused(mean, scale):
        def total(mean, scale):
            found = jl.beliefs.fuse(jl.beliefs.Gaussian(mean, scale * jnp.eye(2)), one)
            return jnp.sum(found.mean) + jnp.sum(found.covariance), found

        return jax.value_and_grad(total, argnums=(0, 1), has_aux=True)(mean, scale)

    scales = jnp.array([2.0, jnp.nan, jnp.inf, -1.0, 1e30, 1.0, 0.0])
    means = jnp.zeros((7, 2)).at[5, 0].set(jnp.nan)
    (_, found), slopes = fused(means, scales)
    assert bool(tree.all_finite((found, slopes)))
    np.testing.assert_allclose(found.mean[1:6], 1.0)
    np.testing.assert_allclose(found.covariance[1:6], np.broadcast_to(2.0 * np.eye(2), (5, 2, 2)))
    np.testing.assert_allclose(found.mean[0], 0.5, atol=1e-6)


def test_reduction_of_a_mixture_with_a_broken_component():
    @jax.jit
    @jax.vmap
    def reduced(weight, mean):
        def total(weight, mean):
            mixture = jl.beliefs.Mixture(
                jnp.array([1.0, 0.0, 0.5]).at[1].set(weight),
                jnp.array([[0.0], [9.0], [50.0]]).at[1, 0].set(mean),
                jnp.ones((3, 1, 1)),
            )
            found = jl.beliefs.reduce_mixture(mixture, 3).mixture
            return jnp.sum(found.weights * found.means[:, 0] ** 2), found

        return jax.value_and_grad(total, argnums=(0, 1), has_aux=True)(weight, mean)

    weights = jnp.array([0.7, jnp.nan, jnp.inf, 1.0, 1.0])
    means = jnp.array([9.0, 9.0, 9.0, jnp.nan, 1e30])
    (_, found), slopes = reduced(weights, means)
    assert bool(tree.all_finite((found, slopes)))
    np.testing.assert_allclose(found.weights[1:], np.tile([1.0, 0.5, 0.0], (4, 1)))
    np.testing.assert_allclose(found.weights[0], [1.0, 0.7, 0.5])


def test_validity_of_covariances():
    rng = np.random.default_rng(0)
    roots = jnp.asarray(rng.normal(size=(50, 4, 2)), jnp.float32)
    singular = jax.vmap(lambda root: jnp.einsum("ij,kj->ik", root, root, precision="highest"))(roots)
    assert bool(jax.vmap(validity.is_covariance)(singular).all())
    indefinite = singular - 0.3 * jnp.eye(4)[None]
    assert not bool(jax.vmap(validity.is_covariance)(indefinite).any())
