import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.poses import SE2, compound

PAIRS = [((1.0, 2.0, 0.3), (-0.5, 0.7, 1.2)), ((0.0, 0.0, 0.0), (3.0, -1.0, -2.0)), ((-4.0, 1.0, 2.9), (1.0, 1.0, 0.1))]


def compose(a, b):
    """Kelly's compound in (x, y, theta), without our classes."""
    c, s = np.cos(a[2]), np.sin(a[2])
    return np.array([a[0] + c * b[0] - s * b[1], a[1] + s * b[0] + c * b[1], a[2] + b[2]])


def invert(a):
    c, s = np.cos(a[2]), np.sin(a[2])
    return np.array([-c * a[0] - s * a[1], s * a[0] - c * a[1], -a[2]])


def differences(function, at, step=1e-6):
    return np.stack([(function(at + d) - function(at - d)) / (2 * step) for d in step * np.eye(3)], axis=1)


def parameters(pose):
    return jnp.stack([pose.x, pose.y, pose.theta])


@pytest.mark.parametrize("pair", PAIRS)
def test_jacobians_equal_differences_and_autodiff(pair, x64):  # K-4, K-85
    a, b = (np.array(p) for p in pair)
    left = compound.left_jacobian(SE2(*a), SE2(*b))
    right = compound.right_jacobian(SE2(*a), SE2(*b))
    inverse = compound.inverse_jacobian(SE2(*a))
    np.testing.assert_allclose(left, differences(lambda p: compose(p, b), a), atol=1e-9)
    np.testing.assert_allclose(right, differences(lambda p: compose(a, p), b), atol=1e-9)
    np.testing.assert_allclose(inverse, differences(invert, a), atol=1e-9)
    of_left = jax.jacfwd(lambda p: parameters(SE2(*p) @ SE2(*b)))(jnp.asarray(a))
    of_right = jax.jacrev(lambda p: parameters(SE2(*a) @ SE2(*p)))(jnp.asarray(b))
    of_inverse = jax.jacfwd(lambda p: parameters(SE2(*p).inverse()))(jnp.asarray(a))
    np.testing.assert_allclose(left, of_left, atol=1e-13)
    np.testing.assert_allclose(right, of_right, atol=1e-13)
    np.testing.assert_allclose(inverse, of_inverse, atol=1e-13)


def test_the_form_of_the_lecture(x64):  # K-85
    """``[[1, 0, -(b_k - b_j)], [0, 1, a_k - a_j]]``: a feature is moved by its frame without a rotation of its own."""
    frame, feature = SE2(2.0, 3.0, 0.4), SE2(1.0, -1.0, 0.0)
    a_j, b_j, _ = parameters(frame)
    a_k, b_k, _ = parameters(frame @ feature)
    expected = np.array([[1.0, 0.0, -(b_k - b_j)], [0.0, 1.0, a_k - a_j]])
    np.testing.assert_allclose(compound.left_jacobian(frame, feature)[:2], expected, atol=1e-14)


def test_dtype_and_batches(dtype):
    a = jax.vmap(SE2)(*jnp.asarray(np.array([p[0] for p in PAIRS]).T, dtype))
    b = jax.vmap(SE2)(*jnp.asarray(np.array([p[1] for p in PAIRS]).T, dtype))
    batch = jax.vmap(compound.left_jacobian)(a, b)
    assert batch.dtype == dtype
    one = compound.left_jacobian(jax.tree.map(lambda x: x[1], a), jax.tree.map(lambda x: x[1], b))
    np.testing.assert_allclose(batch[1], one, rtol=1e-6)
    assert jax.vmap(compound.inverse_jacobian)(a).dtype == dtype
