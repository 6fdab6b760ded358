"""The lineax solver by QR beside NumPy's least squares."""

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest

from jaxloc.solvers import QR


def solve(rows, target):
    return lx.linear_solve(lx.MatrixLinearOperator(rows), target, QR(), throw=False).value


@pytest.mark.parametrize("shape", [(3, 3), (20, 3), (40, 15)])
def test_least_squares(rng, x64, shape):
    rows, target = jnp.asarray(rng.normal(size=(4, *shape))), jnp.asarray(rng.normal(size=(4, shape[0])))
    expected = [np.linalg.lstsq(*pair)[0] for pair in zip(rows, target, strict=True)]
    np.testing.assert_allclose(jax.jit(jax.vmap(solve))(rows, target), expected, atol=1e-12)
    np.testing.assert_allclose(solve(rows[0], target[0]), expected[0], atol=1e-12)


def test_the_condition_is_not_squared(x64):
    """A Jacobian of condition 1e9, whose normal equations are singular in double precision."""
    rows = jnp.array([[1.0, 1.0], [1e-9, 0.0], [0.0, 1e-9]])
    np.testing.assert_allclose(solve(rows, rows @ jnp.array([1.0, 2.0])), [1.0, 2.0], rtol=1e-6)


def test_pytrees(rng, x64):
    """Rows and unknowns in several arrays, as a damped step has them."""
    parts = {"a": jnp.asarray(rng.normal(size=(7, 2, 2))), "b": jnp.asarray(rng.normal(size=(7, 3)))}

    def call(x):
        value = jnp.einsum("mij,ij->m", parts["a"], x["a"]) + parts["b"] @ x["b"]
        return value[:3], value[3:]

    truth = {"a": jnp.arange(4.0).reshape(2, 2), "b": jnp.arange(3.0)}
    operator = lx.FunctionLinearOperator(call, jax.eval_shape(lambda: truth))
    found = lx.linear_solve(operator, call(truth), QR()).value
    assert found.keys() == truth.keys()
    np.testing.assert_allclose(found["a"], truth["a"], atol=1e-12)
    np.testing.assert_allclose(found["b"], truth["b"], atol=1e-12)


@pytest.mark.parametrize("rows", [jnp.zeros((4, 2)), jnp.ones((1, 2))])
def test_deficient_systems_have_no_finite_solution(rows):
    assert not jnp.isfinite(solve(rows, jnp.ones(rows.shape[0]))).all()
