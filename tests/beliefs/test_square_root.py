import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jaxloc.beliefs import square_root


def spd(rng, size, dtype=np.float64):
    a = rng.normal(size=(size, size)) * np.geomspace(1e-3, 1e2, size)[:, None]
    return jnp.asarray(a @ a.T, dtype)


@pytest.mark.parametrize("size", [1, 6, 12])
def test_root_equals_numpy(x64, rng, size):
    covariance = spd(rng, size)
    root = square_root.cholesky(covariance)
    assert np.allclose(root @ root.T, covariance, rtol=1e-12, atol=1e-12 * float(jnp.abs(covariance).max()))
    scale = np.sqrt(np.diag(covariance))[:, None]
    assert np.allclose(root / scale, np.linalg.cholesky(covariance) / scale, atol=1e-8)


@pytest.mark.parametrize("size", [3, 12])
def test_whiten_and_solve(x64, rng, size):
    covariance, right = spd(rng, size), jnp.asarray(rng.normal(size=(size, 2)))
    root = square_root.cholesky(covariance)
    assert np.allclose(root @ square_root.whiten(root, right), right)
    assert np.allclose(covariance @ square_root.solve(root, right), right, atol=1e-6)
    assert np.allclose(square_root.solve(root, right[:, 0]), square_root.solve(root, right)[:, 0])


@pytest.mark.slow
@pytest.mark.parametrize("size", [3, 12])
def test_singular_covariances_stay_finite(dtype, size):
    @jax.jit
    def everything(covariance):
        root, pull = jax.vjp(square_root.cholesky, covariance)
        return root, square_root.whiten(root, jnp.ones(size, dtype)), pull(root)[0]

    ones = jnp.ones((size, size), dtype)
    eye = jnp.eye(size, dtype=dtype)
    for covariance in (ones, jnp.zeros_like(ones), jnp.arange(size, dtype=dtype)[None] * eye, ones - 2 * eye):
        root, white, gradient = everything(covariance)
        assert root.dtype == dtype
        assert np.isfinite(root).all() and np.isfinite(white @ white) and np.isfinite(gradient).all()
    assert np.allclose(square_root.cholesky(ones)[:, 0], 1.0, atol=1e-5)
    assert np.allclose(square_root.cholesky(jnp.zeros_like(ones)), 0.0, atol=1e-9)


def test_gradient_equals_differences(x64, rng):
    covariance = spd(rng, 4)

    @jax.jit
    def total(c):
        return jnp.sum(jnp.sin(square_root.cholesky(0.5 * (c + c.T))))

    gradient = jax.jit(jax.grad(total))(covariance)
    for i in range(4):
        step = np.zeros((4, 4))
        step[i, 1] = 1e-6 * np.sqrt(covariance[i, i] * covariance[1, 1])
        difference = (total(covariance + step) - total(covariance - step)) / (2 * step[i, 1])
        assert np.isclose(gradient[i, 1], difference, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("shape", [(4, 8), (3, 2), (17, 20)])
def test_triangularize_equals_numpy(x64, rng, shape):
    a = rng.normal(size=shape)
    root = np.asarray(square_root.triangularize(jnp.asarray(a)))
    assert np.allclose(root, np.tril(root)) and (np.diag(root) >= 0).all()
    assert np.allclose(root @ root.T, a @ a.T, atol=1e-12)


def test_triangularize_keeps_small_variances(rng):
    # Variances ten orders of magnitude apart, in float32: the product A A^T would lose the small one.
    a = np.array([[1e3, 1.0, 0.0], [1e3, 1.0, 1e-2]])
    root = np.asarray(square_root.triangularize(jnp.asarray(a, jnp.float32)))
    exact = np.linalg.qr(a.T, mode="r").T
    assert np.isclose(root[1, 1], abs(exact[1, 1]), rtol=1e-2)


@pytest.mark.parametrize("shape", [(3, 5), (15, 16)])
def test_triangularize_derivatives(x64, rng, shape):
    a = jnp.asarray(rng.normal(size=shape))
    weights = jnp.asarray(rng.normal(size=(shape[0], shape[0])))
    order = 2 if shape[0] < 9 else 1

    @jax.jit
    def total(a):
        return jnp.sum(jnp.sin(square_root.triangularize(jnp.asarray(a))) * weights)

    check_grads(total, (a,), order=order, rtol=1e-4)


def test_triangularize_of_dependent_rows(dtype):
    a = jnp.asarray([[1.0, 2.0, 0.0], [0.0, 0.0, 0.0], [2.0, 4.0, 0.0], [0.0, 1.0, 3.0]], dtype)
    root, pull = jax.vjp(square_root.triangularize, a)
    (gradient,) = pull(jnp.ones_like(root))
    assert root.dtype == dtype and np.isfinite(gradient).all()
    assert np.allclose(root @ root.T, a @ a.T, atol=1e-5)
    # A row that depends on another turns with it: the derivative of the product still holds.
    _, change = jax.jvp(square_root.triangularize, (a,), (a,))
    assert np.allclose(change, root, atol=1e-5)


def test_downdate(x64, rng):
    root = np.linalg.cholesky(np.asarray(spd(rng, 4)))
    vector = 0.3 * root @ rng.normal(size=4)
    found = np.asarray(square_root.downdate(jnp.asarray(root), jnp.asarray(vector)))
    assert np.allclose(found @ found.T, root @ root.T - np.outer(vector, vector), rtol=1e-9, atol=1e-12)


@pytest.mark.slow
def test_downdate_never_fails(dtype):
    eye = jnp.eye(3, dtype=dtype)
    for root in (eye, jnp.zeros_like(eye)):
        for length in (1.0, 5.0, 1e6):
            found, pull = jax.vjp(square_root.downdate, root, length * eye[0])
            assert np.isfinite(found).all() and all(np.isfinite(part).all() for part in pull(found))
