import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.poses import series

ANGLES = np.array([0.0, 1e-8, 1e-6, 1e-4, 1e-2, 0.1, 0.4999999, 0.5, 0.5000001, 1.0, 2.0, 3.0, np.pi - 1e-3])


def integral(weight, a):
    """Gauss-Legendre integral over (0, 1): every coefficient is one, free of cancellation."""
    nodes, weights = np.polynomial.legendre.leggauss(48)
    t = 0.5 * (nodes + 1.0)
    return float(np.sum(0.5 * weights * weight(t, a)))


def half_sinc(t, a):
    return np.sinc(a * t / (2.0 * np.pi))


def cotangent(a):
    moment = integral(lambda t, a: -2.0 * (1.0 - 2.0 * t) * 0.25 * t**2 * half_sinc(t, a) ** 2, a)
    return moment / (2.0 * integral(lambda t, a: (1.0 - t) * np.cos(a * t), a))


ORACLES = {
    "sinc": lambda a: integral(lambda t, a: np.cos(a * t), a),
    "versine": lambda a: integral(lambda t, a: (1.0 - t) * np.cos(a * t), a),
    "third": lambda a: integral(lambda t, a: (1.0 - t) ** 2 / 2.0 * np.cos(a * t), a),
    "fourth": lambda a: integral(lambda t, a: (1.0 - t) ** 3 / 6.0 * np.cos(a * t), a),
    "fifth": lambda a: integral(lambda t, a: (1.0 - t) ** 4 / 24.0 * (np.cos(a * t) - 0.5 * a * t * np.sin(a * t)), a),
    "cotangent": cotangent,
}


@pytest.mark.parametrize("name", ORACLES)
def test_equals_its_integral_form(name, dtype):
    angles = ANGLES.astype(dtype)
    found = jax.vmap(getattr(series, name))(jnp.asarray(angles) ** 2)
    assert found.dtype == dtype
    expected = [ORACLES[name](float(a)) for a in angles]
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=2e-14 if dtype == np.float64 else 2e-6)


@pytest.mark.parametrize("name", ORACLES)
def test_derivatives_are_smooth_through_zero_and_the_switch(name, x64):
    function = getattr(series, name)
    second = jax.vmap(jax.grad(jax.grad(function)))
    at = jnp.array([0.0, 1e-16, 0.25 - 1e-12, 0.25 + 1e-12, 1.0])
    assert np.all(np.isfinite(second(at)))
    slopes = jax.vmap(jax.grad(function))(at)
    assert abs(float(slopes[0] - slopes[1])) < 1e-14
    assert abs(float(slopes[2] - slopes[3])) < 1e-12
    step = 1e-4
    difference = (function(jnp.array(step)) - function(jnp.array(0.0))) / step
    assert abs(float(difference - slopes[0])) < 1e-4 * abs(float(slopes[0])) + 1e-11
