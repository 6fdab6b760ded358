import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest

from jaxloc.solvers import Cholesky
from jaxloc.solvers.cholesky import factor, rank_tolerance


def positive(rng, size, ratio=1.0):
    root = rng.normal(size=(size, size + 3)) * np.geomspace(1.0, ratio, size)[:, None]
    return root @ root.T


@eqx.filter_jit
def answers(matrix, vector):
    found = factor(matrix)
    return found.solve(vector), found.inverse(), found.deficient


@pytest.mark.parametrize("size", [1, 2, 6, 9, 12])
def test_solve_and_inverse_equal_numpy(size, x64, rng):
    matrix, vector = positive(rng, size, ratio=1e3), rng.normal(size=size)
    solution, inverse, deficient = answers(jnp.asarray(matrix), jnp.asarray(vector))
    assert not bool(deficient)
    expected = np.linalg.inv(matrix)
    sigma = np.sqrt(np.diagonal(expected))
    assert np.abs((inverse - expected) / np.outer(sigma, sigma)).max() < 1e-10
    assert np.abs((solution - np.linalg.solve(matrix, vector)) / sigma).max() < 1e-9 * np.linalg.norm(vector * sigma)


@pytest.mark.parametrize("size", [3, 6, 12])
def test_single_precision(size, rng):
    matrix, vector = positive(rng, size), rng.normal(size=size)
    solution, inverse, deficient = answers(jnp.asarray(matrix, jnp.float32), jnp.asarray(vector, jnp.float32))
    assert solution.dtype == inverse.dtype == np.float32 and not bool(deficient)
    np.testing.assert_allclose(solution, np.linalg.solve(matrix, vector), rtol=2e-3, atol=1e-4)
    np.testing.assert_allclose(inverse, np.linalg.inv(matrix), rtol=2e-3, atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("size", [6, 12])
@pytest.mark.parametrize("kind", ["rank one less", "zero row", "all zero", "nan"])
def test_deficient_matrices_are_flagged_and_finite(size, kind, dtype, rng):
    root = rng.normal(size=(size, size - 1 if kind == "rank one less" else size + 2))
    matrix = root @ root.T
    if kind == "zero row":
        matrix[1] = matrix[:, 1] = 0.0
    elif kind == "all zero":
        matrix[:] = 0.0
    elif kind == "nan":
        matrix[0, 0] = matrix[0, 1] = matrix[1, 0] = np.nan
    vector = jnp.asarray(rng.normal(size=size), dtype)
    solution, inverse, deficient = answers(jnp.asarray(matrix, dtype), vector)
    assert bool(deficient) and np.all(np.isfinite(solution)) and np.all(np.isfinite(inverse))
    assert solution.dtype == dtype
    gradient = jax.grad(lambda m: jnp.sum(answers(m, vector)[0]) + jnp.sum(answers(m, vector)[1]))
    assert np.all(np.isfinite(jax.jit(gradient)(jnp.asarray(matrix, dtype))))


def test_undetermined_pivots_do_not_move(x64):
    matrix = jnp.array([[4.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    solution, inverse, _ = answers(matrix, jnp.array([8.0, 5.0, 3.0]))
    np.testing.assert_allclose(solution, [2.0, 0.0, 3.0])
    assert float(inverse[1, 1]) > 1e10


@pytest.mark.parametrize("size", [4, 11])
def test_derivatives_equal_those_of_the_inverse(size, x64, rng):
    matrix, direction = positive(rng, size), rng.normal(size=(size, size))
    direction = direction + direction.T
    _, change = jax.jvp(lambda m: answers(m, jnp.ones(size))[1], (jnp.asarray(matrix),), (jnp.asarray(direction),))
    inverse = np.linalg.inv(matrix)
    expected = -inverse @ direction @ inverse
    np.testing.assert_allclose(change, expected, atol=1e-9 * np.abs(expected).max())


def test_vmap_equals_loop(x64, rng):
    matrices = jnp.asarray(np.stack([positive(rng, 4) for _ in range(5)]))
    vectors = jnp.asarray(rng.normal(size=(5, 4)))
    batch = jax.vmap(answers)(matrices, vectors)
    for i in range(5):
        np.testing.assert_allclose(batch[0][i], answers(matrices[i], vectors[i])[0], rtol=1e-10)


def test_as_a_lineax_solver(x64, rng):
    matrix, vector = jnp.asarray(positive(rng, 5)), jnp.asarray(rng.normal(size=5))
    operator = lx.MatrixLinearOperator(matrix, lx.positive_semidefinite_tag)
    solution = lx.linear_solve(operator, vector, Cholesky())
    np.testing.assert_allclose(solution.value, np.linalg.solve(matrix, vector), rtol=1e-9)
    gradient = jax.grad(lambda v: jnp.sum(lx.linear_solve(operator, v, Cholesky()).value))(vector)
    np.testing.assert_allclose(gradient, np.linalg.solve(matrix, np.ones(5)), rtol=1e-9)


def test_tolerance_knows_its_dtype():
    assert rank_tolerance(np.float32) > 1e8 * rank_tolerance(np.float64)
