"""Derivatives of solutions of equations, against finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from jaxtyping import Array

from jaxloc.poses import SE2
from jaxloc.solvers.implicit_gradient import Equations, attach_gradient


class Kepler(Equations):
    """Kepler's equation ``E - e sin E = M``, elementwise."""

    eccentricity: Array
    anomaly: Array

    def residual(self, value):
        return value - self.eccentricity * jnp.sin(value) - self.anomaly

    def solve(self, value, right, ok):
        del ok
        return right / (1.0 - self.eccentricity * jnp.cos(value))


def solved(eccentricity, anomaly, ok=True):
    """By Newton's method, through which no derivative passes."""
    equations = Kepler(eccentricity, anomaly)
    value = jax.lax.stop_gradient(anomaly)
    for _ in range(20):
        fixed = jax.lax.stop_gradient(equations)
        value = value - fixed.solve(value, fixed.residual(value), True)
    return attach_gradient(value, equations, jnp.asarray(ok))


def test_derivatives_of_first_and_second_order_equal_differences(x64):
    data = jnp.array([0.1, 0.6, 0.3]), jnp.array([0.4, 1.2, 2.5])
    check_grads(jax.jit(solved), data, order=2, modes=["fwd", "rev"], rtol=1e-5)


def test_no_derivative_where_not_ok(x64):
    data = jnp.array([0.3, jnp.nan]), jnp.array([0.4, 1.2])
    found = jax.jacrev(lambda e, m: solved(e, m, ok=False), argnums=(0, 1))(*data)
    assert not np.any(found[0]) and not np.any(found[1])


def test_the_given_value_has_no_derivative(x64):
    equations = Kepler(jnp.array([0.3]), jnp.array([0.4]))
    slope = jax.jacfwd(lambda value: attach_gradient(value, equations, jnp.array(True)))(jnp.array([0.5]))
    assert not np.any(slope)


def test_vmap_equals_loop(x64):
    eccentricity, anomaly = jnp.array([[0.1], [0.7]]), jnp.array([[0.4], [1.9]])
    slope = jax.jacrev(solved)
    batch = jax.vmap(slope)(eccentricity, anomaly)
    for i in range(2):
        np.testing.assert_allclose(batch[i], slope(eccentricity[i], anomaly[i]), rtol=1e-12)


class Square(Equations):
    """A pose whose square is given; the default `move` is the retraction of poses."""

    square: SE2

    def residual(self, value):
        return self.square.local(value @ value)

    def solve(self, value, right, ok):
        matrix = jax.jacfwd(lambda delta: self.residual(value.retract(delta)))(jnp.zeros(3))
        return jnp.linalg.solve(matrix, right)


def half(square):
    """The square root of a motion, by its logarithm."""
    return jax.lax.stop_gradient(SE2.exp(0.5 * square.log()))


@pytest.mark.parametrize("angle", [0.0, 1.5])
def test_poses_move_on_their_manifold(angle, x64):
    square = SE2(0.4, -1.0, angle)
    weights = jnp.array([1.0, -2.0, 0.5])

    def implicit(delta):
        moved = square.retract(delta)
        return jnp.sum(weights * attach_gradient(half(moved), Square(moved), jnp.array(True)).log())

    def explicit(delta):
        return jnp.sum(weights * 0.5 * square.retract(delta).log())

    at = jnp.array([0.01, 0.02, -0.03])
    np.testing.assert_allclose(jax.grad(implicit)(at), jax.grad(explicit)(at), rtol=1e-9)
