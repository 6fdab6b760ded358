"""Rotations in the plane against matrix exponentials."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import expm

from jaxloc.poses import SO2, wrap_angle


def test_planar_rotation(dtype):
    bound = 1e-13 if dtype == np.float64 else 1e-6
    for angle in (0.0, 1e-8, 1e-4, 0.1, 1.0, 3.0, np.pi - 1e-3):
        rotation = SO2.exp(jnp.asarray([angle], dtype))
        expected = expm(np.array([[0.0, -angle], [angle, 0.0]]))
        assert np.abs(rotation.matrix() - expected).max() <= bound
        assert abs(float(rotation.log()[0]) - angle) <= bound
        assert rotation.log().dtype == dtype
    points = jnp.asarray([[1.0, 2.0], [3.0, -1.0]], dtype)
    np.testing.assert_allclose(rotation.apply(points), np.asarray(points) @ expected.T, atol=1e-6)
    assert SO2.left_jacobian(jnp.ones(1, dtype)).item() == 1.0


def test_planar_log_has_finite_derivatives_everywhere(x64):
    for angle in (0.0, np.pi, -np.pi / 2):
        second = jax.hessian(lambda x: SO2.from_angle(x).compose(SO2.from_angle(x)).log()[0])(angle)
        assert np.isfinite(second)


def test_wrap_angle():
    angles = jnp.array([0.0, 3.0, 4.0, -4.0, 7.0, -jnp.pi])
    wrapped = wrap_angle(angles)
    np.testing.assert_allclose(np.exp(1j * np.asarray(wrapped)), np.exp(1j * np.asarray(angles)), atol=1e-6)
    assert np.all(wrapped >= -np.pi - 1e-6) and np.all(wrapped < np.pi)
    assert np.array_equal(jax.vmap(jax.grad(wrap_angle))(angles), np.ones(6))


def test_normalize_returns_a_rotation(x64):
    turned = SO2(jnp.asarray(1.1 * np.cos(0.3)), jnp.asarray(1.1 * np.sin(0.3))).normalize()
    assert abs(float(turned.cos) - np.cos(0.3)) < 1e-15 and abs(float(turned.sin) - np.sin(0.3)) < 1e-15
