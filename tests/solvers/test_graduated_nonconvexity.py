"""Graduated non-convexity reaches the right minimum from where plain descent does not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from jaxloc.solvers import FunctionProblem, GemanMcClure, LevenbergMarquardt, Quadratic, Tukey, solve, solve_graduated


def deviations(state, data):
    return state - data


@pytest.fixture
def data(rng):
    """Thirty values about 1, twelve that agree on 30."""
    return jnp.asarray(np.concatenate([1 + rng.normal(size=30), 30 + rng.normal(size=12)]), jnp.float32)


def test_finds_the_global_minimum_where_descent_stays_with_the_outliers(data):
    problem = FunctionProblem(deviations, data, GemanMcClure(2.0))
    local = solve(problem, jnp.array(29.0), solver=LevenbergMarquardt())
    found = solve_graduated(problem, jnp.array(29.0))
    values = np.asarray(data, np.float64)
    oracle = minimize_scalar(lambda x: np.sum(0.5 * (x - values) ** 2 / (1 + (x - values) ** 2 / 4)), bounds=(-3, 5))
    assert abs(float(local.value) - 30) < 2
    assert float(found.value) == pytest.approx(oracle.x, abs=1e-3)
    assert float(found.cost) < float(local.cost)


def test_result_and_gradient_are_those_of_the_problem_itself(data, x64):
    data = data.astype(jnp.float64)

    def value(data):
        return solve_graduated(FunctionProblem(deviations, data, Tukey(5.0)), jnp.array(20.0)).value

    gradient = jax.jit(jax.grad(value))(data)
    for i in (0, 7, 35):
        step = jnp.zeros_like(data).at[i].set(1e-5)
        assert float(gradient[i]) == pytest.approx(float(value(data + step) - value(data - step)) / 2e-5, abs=1e-7)


def test_plain_least_squares_is_left_as_it_is(data):
    problem = FunctionProblem(deviations, data, Quadratic())
    assert float(solve_graduated(problem, jnp.array(5.0)).value) == pytest.approx(float(jnp.mean(data)), rel=1e-5)
