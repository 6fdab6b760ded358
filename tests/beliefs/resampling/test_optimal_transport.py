"""Optimal transport of particles against a linear program."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from jaxloc.beliefs.resampling import optimal_transport
from jaxloc.poses import SE2


def test_transport_equals_a_linear_program(x64, rng):
    from scipy.optimize import linprog

    n = 12
    points, weights = rng.normal(size=(n, 2)), rng.uniform(0.2, 1.0, size=n)
    weights /= weights.sum()
    moved = jax.jit(partial(optimal_transport, epsilon=2e-3, iterations=3000))(jnp.asarray(points), jnp.log(weights))
    cost = np.sum((points[:, None] - points[None]) ** 2, -1)
    rows, columns = np.kron(np.eye(n), np.ones(n)), np.kron(np.ones(n), np.eye(n))
    found = linprog(cost.ravel(), A_eq=np.r_[rows, columns], b_eq=np.r_[np.full(n, 1 / n), weights])
    expected = n * found.x.reshape(n, n) @ points
    assert np.allclose(moved, expected, atol=0.05)
    assert np.allclose(np.mean(moved, 0), weights @ points, atol=1e-12)


def test_transport_of_poses_and_nonfinite_weights():
    poses = jax.vmap(SE2)(jnp.arange(5.0), jnp.zeros(5), jnp.array([3.1, -3.1, 3.0, -3.0, 3.14]))
    moved = jax.jit(optimal_transport)(poses, jnp.array([0.0, 1.0, -jnp.inf, jnp.nan, 2.0]))
    assert bool(jnp.all(jnp.isfinite(moved.translation))) and bool(jnp.all(moved.rotation.cos < -0.9))
    same = jax.jit(optimal_transport)(jnp.ones((4, 2)), jnp.zeros(4))
    assert np.allclose(same, 1.0)
