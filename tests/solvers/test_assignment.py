"""T-58: assignment against SciPy's, on thousands of masked rectangular matrices, and its gradient."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from jaxloc.solvers import assign

batched = jax.jit(jax.vmap(assign))
batched_alone = jax.jit(jax.vmap(lambda costs, valid, alone: assign(costs, valid, unassigned=alone)))


def best(costs, valid):
    """Number of pairs and total cost: a forbidden pair costs more than all others together."""
    forbidden = ~valid | ~np.isfinite(costs)
    safe = np.where(forbidden, 0.0, costs)
    rows, columns = linear_sum_assignment(np.where(forbidden, 1e5, safe))
    kept = ~forbidden[rows, columns]
    return kept.sum(), safe[rows, columns][kept].sum()


def best_alone(costs, valid, alone):
    """Total cost where row i may stay alone in a column of its own."""
    rows = len(costs)
    private = np.where(np.eye(rows, dtype=bool), alone[:, None], 1e5)
    table = np.hstack([np.where(valid & np.isfinite(costs), costs, 1e5), private])
    return table[linear_sum_assignment(table)].sum()


def random_problems(rng, count, shape):
    """A third has small integers (ties), and all have their own density of allowed pairs, down to none."""
    costs = rng.uniform(-5.0, 20.0, (count, *shape))
    costs[: count // 3] = rng.integers(0, 5, (count // 3, *shape))
    valid = rng.uniform(size=costs.shape) < rng.uniform(0.0, 1.3, (count, 1, 1))
    costs[rng.uniform(size=costs.shape) < 0.02] = np.nan
    costs[rng.uniform(size=costs.shape) < 0.02] = np.inf
    return costs, valid


def check_is_assignment(columns, costs, valid):
    """No forbidden pair, no column twice."""
    matrix, row = np.nonzero(columns >= 0)
    column = columns[matrix, row]
    assert valid[matrix, row, column].all() and np.isfinite(costs[matrix, row, column]).all()
    assert len(set(zip(matrix, column, strict=True))) == len(matrix)


@pytest.mark.parametrize("shape", [(6, 6), (5, 12), (12, 5)])
def test_costs_are_scipys(rng, dtype, shape):
    count = 1700
    costs, valid = random_problems(rng, count, shape)
    costs = costs.astype(dtype)
    found = batched(jnp.asarray(costs), jnp.asarray(valid))
    columns = np.asarray(found.columns)
    assert found.cost.dtype == dtype and columns.shape == (count, shape[0])
    check_is_assignment(columns, costs, valid)
    expected = np.array([best(c.astype(float), v) for c, v in zip(costs, valid, strict=True)])
    np.testing.assert_array_equal((columns >= 0).sum(axis=1), expected[:, 0])
    np.testing.assert_allclose(found.cost, expected[:, 1], atol=1e-3 if dtype == np.float32 else 1e-9)


@pytest.mark.parametrize("shape", [(5, 12), (12, 5)])
def test_rows_may_pay_to_stay_alone(rng, dtype, shape):
    costs, valid = random_problems(rng, 500, shape)
    alone = rng.uniform(0.0, 15.0, (500, shape[0]))
    found = batched_alone(jnp.asarray(costs, dtype), jnp.asarray(valid), jnp.asarray(alone, dtype))
    check_is_assignment(np.asarray(found.columns), costs, valid)
    expected = [best_alone(*problem) for problem in zip(costs, valid, alone, strict=True)]
    np.testing.assert_allclose(found.cost, expected, atol=1e-3 if dtype == np.float32 else 1e-9)


def test_a_row_that_must_have_a_column_gets_it_first(x64):
    costs, valid = jnp.array([[1.0], [50.0]]), jnp.ones((2, 1), bool)
    found = assign(costs, valid, unassigned=jnp.array([3.0, jnp.inf]))
    assert found.columns.tolist() == [-1, 0] and float(found.cost) == 53.0


def test_one_call_is_one_of_a_batch(rng):
    costs, valid = (jnp.asarray(x) for x in random_problems(rng, 5, (6, 6)))
    found = batched(costs, valid)
    for index in range(5):
        one = assign(costs[index], valid[index])
        np.testing.assert_array_equal(one.columns, found.columns[index])


def test_a_masked_row_or_column_is_an_absent_one(rng, x64):
    costs = jnp.asarray(rng.uniform(size=(6, 6)))
    valid = jnp.ones((6, 6), bool).at[2].set(False).at[:, 4].set(False)
    inner = np.delete(np.delete(np.asarray(costs), 2, 0), 4, 1)
    rows, columns = linear_sum_assignment(inner)
    poisoned = costs.at[2].set(jnp.nan).at[:, 4].set(-jnp.inf)
    for table in (costs, poisoned):
        found = assign(table, valid)
        assert float(found.cost) == pytest.approx(inner[rows, columns].sum(), abs=1e-12)
        np.testing.assert_array_equal(np.delete(np.asarray(found.columns), 2), np.delete(np.arange(6), 4)[columns])
    assert assign(costs, jnp.zeros((6, 6), bool)).columns.tolist() == [-1] * 6
    assert assign(costs[:0], valid[:0]).columns.shape == (0,)


def test_the_gradient_is_that_of_the_pairs_chosen(rng, x64):
    costs, valid = jnp.asarray(rng.uniform(size=(6, 6))), jnp.asarray(rng.uniform(size=(6, 6)) < 0.8)
    costs = costs.at[0, 0].set(jnp.nan)
    alone = jnp.full((6,), 0.3)
    columns = np.asarray(assign(costs, valid, unassigned=alone).columns)
    slopes, stay = jax.grad(lambda c, a: assign(c, valid, unassigned=a).cost, argnums=(0, 1))(costs, alone)
    expected = np.zeros((6, 6))
    expected[np.nonzero(columns >= 0)[0], columns[columns >= 0]] = 1.0
    np.testing.assert_array_equal(slopes, expected)
    np.testing.assert_array_equal(stay, columns < 0)
