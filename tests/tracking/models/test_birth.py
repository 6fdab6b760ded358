"""Where targets appear."""  # T-75

import jax.numpy as jnp
import numpy as np
import pytest

import jaxloc as jl


def test_no_births_is_the_default():
    birth = jl.tracking.Birth()
    assert birth.mixture(jnp.zeros(4)).capacity == 0
    assert birth.log_intensity(jnp.zeros(2)) is None and birth.seed(jnp.zeros(2)) is None


def test_static_births_are_their_intensity():
    places = jl.beliefs.Mixture(jnp.array([0.1, 0.2]), jnp.ones((2, 4)), jnp.stack([jnp.eye(4)] * 2))
    birth = jl.tracking.StaticBirth(places)
    assert birth.mixture(jnp.zeros(4)) is places and birth.log_intensity(jnp.zeros(2)) is None


def test_measured_births_are_everywhere_alike(dtype):
    noise = jnp.array([[4.0, 1.0], [1.0, 9.0]], dtype)
    birth = jl.tracking.PointBirth(jnp.asarray(0.5, dtype), 200.0, noise, jnp.array([25.0, 16.0], dtype))
    z = jnp.array([3.0, -2.0], dtype)
    assert float(jnp.exp(birth.log_intensity(z))) == pytest.approx(0.5 / 200.0)
    assert birth.mixture(jnp.zeros(4, dtype)).capacity == 0
    seed = birth.seed(z)
    assert seed.mean.dtype == dtype and seed.mean.tolist() == [3.0, -2.0, 0.0, 0.0]
    expected = np.zeros((4, 4))
    expected[:2, :2], expected[2:, 2:] = noise, np.diag([25.0, 16.0])
    np.testing.assert_array_equal(seed.covariance, expected)
