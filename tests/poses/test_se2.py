import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from jaxloc.poses import SE2

ANGLES = [0.0, 1e-8, 1e-6, 1e-4, 1e-2, 0.1, 0.4999999, 0.5, 0.5000001, 1.0, 2.0, 3.0, np.pi - 1e-3]
TWISTS = np.array([[0.6, -0.8, sign * a] for a in ANGLES for sign in (1.0, -1.0)])


def hat(xi):
    return np.array([[0.0, -xi[2], xi[0]], [xi[2], 0.0, xi[1]], [0.0, 0.0, 0.0]])


def small_adjoint(xi):
    """``ad`` with ``expm(ad(xi)) == Adjoint(exp(xi))``."""
    return np.array([[0.0, -xi[2], xi[1]], [xi[2], 0.0, -xi[0]], [0.0, 0.0, 0.0]])


def mean_exponential(generator):
    n = generator.shape[0]
    return expm(np.block([[generator, np.eye(n)], [np.zeros((n, 2 * n))]]))[:n, n:]


def test_exp_equals_expm(dtype):
    twists = TWISTS.astype(dtype)
    found = jax.vmap(lambda xi: SE2.exp(xi).matrix())(jnp.asarray(twists))
    assert found.dtype == dtype
    expected = np.stack([expm(hat(xi.astype(float))) for xi in twists])
    assert np.abs(found - expected).max() <= (1e-13 if dtype == np.float64 else 1e-6)


def test_log_returns_what_exp_was_given(dtype):
    twists = jnp.asarray(TWISTS, dtype)
    found = jax.vmap(lambda xi: SE2.exp(xi).log())(twists)
    assert found.dtype == dtype
    assert np.abs(found - twists).max() <= (1e-13 if dtype == np.float64 else 1e-6)


def test_jacobians_equal_the_mean_adjoint(x64):
    both = jax.jit(lambda xi: (SE2.left_jacobian(xi), SE2.left_jacobian_inverse(xi)))
    for xi in TWISTS:
        expected = mean_exponential(small_adjoint(xi))
        jacobian, inverse = both(jnp.asarray(xi))
        assert np.abs(jacobian - expected).max() <= 1e-13
        assert np.abs(inverse - np.linalg.inv(expected)).max() <= 1e-12


def test_right_jacobian_is_the_derivative_of_exp(x64):
    @jax.jit
    def derivative(xi):
        return jax.jacfwd(lambda x: SE2.exp(xi).local(SE2.exp(x)))(xi), SE2.left_jacobian(-xi)

    for xi in TWISTS:
        found, expected = derivative(jnp.asarray(xi))
        assert np.abs(found - expected).max() <= 1e-10


def test_adjoint_equals_expm_of_the_small_adjoint(x64):
    adjoint = jax.jit(lambda xi: SE2.exp(xi).adjoint())
    for xi in TWISTS:
        assert np.abs(adjoint(jnp.asarray(xi)) - expm(small_adjoint(xi))).max() <= 1e-13


@jax.jit
def derivatives_of_log(pose):
    def log(delta):
        return pose.retract(delta).log()

    zero = jnp.zeros(3, pose.translation.dtype)
    return jax.jacfwd(log)(zero), jax.jacrev(log)(zero), jax.jacfwd(jax.jacrev(log))(zero)


@pytest.mark.parametrize("theta", [0.0, 1e-9, np.pi, -np.pi / 2])
def test_derivatives_are_finite_to_second_order(theta, dtype):
    forward, backward, second = derivatives_of_log(SE2(jnp.asarray(1.0, dtype), 2.0, theta))
    assert forward.dtype == dtype
    assert np.all(np.isfinite(forward)) and np.all(np.isfinite(second))
    np.testing.assert_allclose(forward, backward, atol=1e-4)


def test_second_derivative_of_exp_at_identity(x64):
    second = jax.jit(jax.jacfwd(jax.jacrev(lambda xi: SE2.exp(xi).translation)))(jnp.zeros(3))
    assert float(second[1, 0, 2]) == 0.5 and float(second[0, 1, 2]) == -0.5


def test_construction_and_parts(dtype):
    pose = SE2(jnp.asarray(1.0, dtype), 2.0, 0.3)
    assert pose.matrix().dtype == dtype and pose.theta.dtype == dtype
    expected = np.array([[np.cos(0.3), -np.sin(0.3), 1.0], [np.sin(0.3), np.cos(0.3), 2.0], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(pose.matrix(), expected, atol=1e-7)
    np.testing.assert_allclose(SE2.from_matrix(pose.matrix()).matrix(), pose.matrix())
    np.testing.assert_allclose([pose.x, pose.y, pose.theta], [1.0, 2.0, 0.3], rtol=1e-6)
    points = jnp.asarray([[1.0, 0.0], [0.0, -2.0]], dtype)
    homogeneous = np.column_stack([points, np.ones(2)])
    np.testing.assert_allclose(pose.apply(points), (homogeneous @ expected.T)[:, :2], atol=1e-6)
    assert np.array_equal(SE2.identity(dtype).matrix(), np.eye(3)) and SE2.identity(dtype).translation.dtype == dtype


@jax.jit
def violations(xs):
    a, b, c = (SE2.exp(x) for x in xs)
    one, delta = SE2.identity(xs.dtype), 0.3 * xs[1]
    pairs = [
        ((a @ b) @ c, a @ (b @ c)),
        (a @ one, a),
        (one @ a, a),
        (a @ a.inverse(), one),
        ((a @ b).inverse(), b.inverse() @ a.inverse()),
        (a @ SE2.exp(delta), SE2.exp(a.adjoint() @ delta) @ a),
        (a.retract(a.local(b)), b),
        (a.normalize(), a),
    ]
    return jnp.stack([jnp.max(jnp.abs(p.matrix() - q.matrix())) for p, q in pairs])


@settings(max_examples=40, deadline=None)
@given(values=st.lists(st.floats(-3.0, 3.0, width=32), min_size=9, max_size=9))
def test_group_axioms(values):
    assert float(violations(jnp.asarray(values, jnp.float32).reshape(3, 3)).max()) < 2e-5


def test_stacks_and_jit(x64):
    twists = jnp.asarray(TWISTS)
    stack = jax.vmap(SE2.exp)(twists)
    assert stack.batch_shape == (len(TWISTS),)
    logs = jax.vmap(lambda pose: pose.log())(stack)
    for i in (0, 7, 20):
        np.testing.assert_allclose(logs[i], SE2.exp(twists[i]).log(), atol=1e-14)
        np.testing.assert_allclose(logs[i], jax.jit(lambda xi: SE2.exp(xi).log())(twists[i]), atol=1e-14)
