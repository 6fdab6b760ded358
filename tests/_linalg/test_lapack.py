"""Decompositions beside NumPy's and SciPy's, alone and in batches, with derivatives beside finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from jax.test_util import check_grads

from jaxloc._linalg import eigh, first_cholesky, inverse, matmul, qr, solve, solve_lower, svd, triangular_factor

SIZES = (1, 2, 3, 6, 12, 21)


def covariances(rng, count, size, dtype):
    a = rng.normal(size=(count, size, size))
    return jnp.asarray(a @ a.transpose(0, 2, 1) + np.eye(size), dtype)


def tolerance(dtype):
    return 2e-3 if np.dtype(dtype) == np.float32 else 1e-10


@pytest.mark.parametrize("size", SIZES)
def test_cholesky(rng, dtype, size):
    matrices = covariances(rng, 5, size, dtype)
    trials = jnp.stack([matrices, matrices + jnp.eye(size, dtype=dtype)[None]], axis=1)
    lower, first = jax.jit(jax.vmap(first_cholesky))(trials)
    np.testing.assert_allclose(lower, np.linalg.cholesky(np.asarray(matrices)), atol=tolerance(dtype))
    assert first.all() and lower.dtype == dtype


def test_the_first_positive_definite_matrix_is_factored():
    trials = jnp.array([[[-1.0]], [[jnp.nan]], [[9.0]]])
    lower, first = first_cholesky(trials)
    assert float(lower[0, 0]) == 3.0 and not first
    lower, first = first_cholesky(-jnp.eye(2)[None])
    np.testing.assert_array_equal(lower, np.eye(2))
    assert not first


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("trailing", [(), (3,)])
def test_solves(rng, dtype, size, trailing):
    matrices = jnp.asarray(rng.normal(size=(5, size, size)), dtype)
    right = jnp.asarray(rng.normal(size=(5, size, *trailing)), dtype)
    found = jax.jit(jax.vmap(solve))(matrices, right)
    again = np.einsum("bij,bj...->bi...", np.asarray(matrices), np.asarray(found))
    np.testing.assert_allclose(again, right, atol=tolerance(dtype))
    lower = jnp.tril(covariances(rng, 5, size, dtype))
    found = jax.jit(jax.vmap(solve_lower))(lower, right)
    expected = [scipy.linalg.solve_triangular(*pair, lower=True) for pair in zip(lower, right, strict=True)]
    np.testing.assert_allclose(found, np.stack(expected), rtol=tolerance(dtype), atol=tolerance(dtype))


def test_elimination_exchanges_rows(x64):
    matrix = jnp.array([[0.0, 1.0, 0.0], [0.0, 0.0, 2.0], [4.0, 0.0, 1.0]])
    np.testing.assert_allclose(inverse(matrix), np.linalg.inv(matrix), atol=1e-14)


@pytest.mark.parametrize("size", [3, 20])
def test_singular_matrices_have_no_finite_solution(size):
    assert not jnp.isfinite(inverse(jnp.zeros((size, size)))).any()
    twice = jnp.zeros((size, size)).at[0].set(1.0).at[1].set(1.0)
    assert not jnp.isfinite(solve(twice, jnp.ones(size))).all()


@pytest.mark.parametrize("size", SIZES)
def test_eigenvalues(rng, dtype, size):
    matrices = covariances(rng, 5, size, dtype)
    values, vectors = jax.jit(jax.vmap(eigh))(matrices)
    np.testing.assert_allclose(values, np.linalg.eigvalsh(np.asarray(matrices)), rtol=tolerance(dtype))
    again = np.einsum("bij,bj,bkj->bik", *(np.asarray(x) for x in (vectors, values, vectors)))
    np.testing.assert_allclose(again, matrices, atol=10 * tolerance(dtype))


@pytest.mark.parametrize("shape", [(3, 3), (9, 5), (9, 7), (20, 6), (5, 9)])
def test_orthogonal_decompositions(rng, dtype, shape):
    matrices = jnp.asarray(rng.normal(size=(4, *shape)), dtype)
    q, r = jax.jit(jax.vmap(qr))(matrices)
    np.testing.assert_allclose(np.asarray(q) @ np.asarray(r), matrices, atol=tolerance(dtype))
    eye = np.broadcast_to(np.eye(shape[0]), q.shape)
    np.testing.assert_allclose(np.asarray(q) @ np.asarray(q).transpose(0, 2, 1), eye, atol=tolerance(dtype))
    np.testing.assert_array_equal(np.tril(np.asarray(r), -1), 0.0)
    factor = jax.vmap(triangular_factor)(matrices)
    np.testing.assert_allclose(np.abs(factor), np.abs(r[:, : factor.shape[1]]), atol=tolerance(dtype))
    left, values, right = jax.jit(jax.vmap(svd))(matrices)
    np.testing.assert_allclose(values, np.linalg.svd(np.asarray(matrices), compute_uv=False), atol=tolerance(dtype))
    again = np.einsum("bik,bk,bkj->bij", *(np.asarray(x) for x in (left, values, right)))
    np.testing.assert_allclose(again, matrices, atol=tolerance(dtype))


def test_reflections_of_a_deficient_matrix_are_finite(dtype):
    matrix = jnp.zeros((4, 3), dtype).at[:, 1].set(2.0)
    q, r = qr(matrix)
    np.testing.assert_allclose(q @ q.T, np.eye(4), atol=1e-6)
    np.testing.assert_allclose(q @ r, matrix, atol=1e-6)


@pytest.mark.parametrize("size", [4, 18])
def test_derivatives(rng, x64, size):
    """Both modes, twice: sizes with and without LAPACK."""
    matrix = covariances(rng, 1, size, np.float64)[0] / size + jnp.diag(jnp.arange(size, dtype=np.float64))
    right = jnp.asarray(rng.normal(size=size))
    lower = jnp.tril(matrix)

    def factor(matrix):
        return first_cholesky(jnp.stack([matrix, matrix + jnp.eye(size)]))[0]

    def symmetric(call):
        return lambda matrix: call(0.5 * (matrix + matrix.T))

    check_grads(jax.jit(symmetric(factor)), (matrix,), order=2, rtol=1e-4)
    check_grads(jax.jit(symmetric(lambda matrix: eigh(matrix)[0])), (matrix,), order=2, rtol=1e-4)
    check_grads(jax.jit(symmetric(lambda matrix: eigh(matrix)[1] ** 2)), (matrix,), order=1, rtol=1e-4)
    check_grads(jax.jit(solve), (matrix, right), order=2, rtol=1e-4)
    check_grads(jax.jit(solve_lower), (lower, right), order=2, rtol=1e-4)
    batch = jnp.stack([matrix, 2.0 * matrix])
    check_grads(jax.jit(jax.vmap(solve, in_axes=(0, None))), (batch, right), order=1, rtol=1e-4)
    check_grads(jax.jit(jax.vmap(symmetric(factor))), (batch,), order=1, modes=["rev"], rtol=1e-3)


def test_derivatives_at_equal_eigenvalues_are_finite():
    assert jnp.isfinite(jax.grad(lambda matrix: jnp.sum(eigh(matrix)[1]))(jnp.eye(3))).all()


def test_batches_of_batches(rng):
    """XLA refuses a product of what nested loops return; batches of batches are one loop."""
    matrices = jnp.asarray(rng.normal(size=(2, 3, 4, 3, 3)), jnp.float32)

    def rotation(matrix):
        left, _, right = svd(matrix)
        return matmul(left, right)

    found = jax.jit(jax.vmap(jax.vmap(jax.vmap(rotation))))(matrices)
    left, _, right = np.linalg.svd(np.asarray(matrices))
    np.testing.assert_allclose(found, left @ right, atol=1e-5)
    fixed = jax.vmap(lambda scale: jax.vmap(lambda matrix: scale * rotation(matrix))(matrices[0, 0]))(jnp.arange(2.0))
    np.testing.assert_allclose(fixed[1], (left @ right)[0, 0], atol=1e-5)
