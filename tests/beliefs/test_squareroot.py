import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.beliefs import squareroot


def spd(rng, size, dtype=np.float64):
    a = rng.normal(size=(size, size)) * np.geomspace(1e-3, 1e2, size)[:, None]
    return jnp.asarray(a @ a.T, dtype)


@pytest.mark.parametrize("size", [1, 6, 12])
def test_root_equals_numpy(x64, rng, size):
    covariance = spd(rng, size)
    root = squareroot.cholesky(covariance)
    assert np.allclose(root @ root.T, covariance, rtol=1e-12, atol=1e-12 * float(jnp.abs(covariance).max()))
    scale = np.sqrt(np.diag(covariance))[:, None]
    assert np.allclose(root / scale, np.linalg.cholesky(covariance) / scale, atol=1e-8)


@pytest.mark.parametrize("size", [3, 12])
def test_whiten_and_solve(x64, rng, size):
    covariance, right = spd(rng, size), jnp.asarray(rng.normal(size=(size, 2)))
    root = squareroot.cholesky(covariance)
    assert np.allclose(root @ squareroot.whiten(root, right), right)
    assert np.allclose(covariance @ squareroot.solve(root, right), right, atol=1e-6)
    assert np.allclose(squareroot.solve(root, right[:, 0]), squareroot.solve(root, right)[:, 0])


@pytest.mark.parametrize("size", [3, 12])
def test_singular_covariances_stay_finite(dtype, size):
    @jax.jit
    def everything(covariance):
        root, pull = jax.vjp(squareroot.cholesky, covariance)
        return root, squareroot.whiten(root, jnp.ones(size, dtype)), pull(root)[0]

    ones = jnp.ones((size, size), dtype)
    eye = jnp.eye(size, dtype=dtype)
    for covariance in (ones, jnp.zeros_like(ones), jnp.arange(size, dtype=dtype)[None] * eye, ones - 2 * eye):
        root, white, gradient = everything(covariance)
        assert root.dtype == dtype
        assert np.isfinite(root).all() and np.isfinite(white @ white) and np.isfinite(gradient).all()
    assert np.allclose(squareroot.cholesky(ones)[:, 0], 1.0, atol=1e-5)
    assert np.allclose(squareroot.cholesky(jnp.zeros_like(ones)), 0.0, atol=1e-9)


def test_gradient_equals_differences(x64, rng):
    covariance = spd(rng, 4)

    @jax.jit
    def total(c):
        return jnp.sum(jnp.sin(squareroot.cholesky(0.5 * (c + c.T))))

    gradient = jax.jit(jax.grad(total))(covariance)
    for i in range(4):
        step = np.zeros((4, 4))
        step[i, 1] = 1e-6 * np.sqrt(covariance[i, i] * covariance[1, 1])
        difference = (total(covariance + step) - total(covariance - step)) / (2 * step[i, 1])
        assert np.isclose(gradient[i, 1], difference, rtol=1e-4, atol=1e-6)
