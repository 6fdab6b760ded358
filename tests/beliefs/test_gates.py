import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2

from jaxloc.beliefs import chi2_cdf, chi2_quantile, gate

PROBABILITIES = np.array([1e-6, 1e-3, 0.05, 0.5, 0.9, 0.95, 0.99, 0.999, 0.999999])


@pytest.mark.parametrize("dof", [1, 2, 3, 6, 9, 100])
def test_quantile_and_cdf_equal_scipy(dtype, dof):  # T-89
    tolerance = 5e-6 if dtype == np.float32 else 1e-12
    probability = PROBABILITIES.astype(dtype)
    got = chi2_quantile(jnp.asarray(probability), jnp.asarray(dof, dtype))
    assert got.dtype == dtype
    assert np.allclose(got, chi2.ppf(np.float64(probability), dof), rtol=tolerance, atol=0)
    x = np.linspace(0, 3 * dof, 9).astype(dtype)
    assert np.allclose(chi2_cdf(jnp.asarray(x), dof), chi2.cdf(np.float64(x), dof), atol=tolerance)


@settings(deadline=None, max_examples=20)
@given(probability=st.floats(1e-9, 1 - 1e-9), dof=st.integers(1, 60))
def test_cdf_inverts_quantile(probability, dof):
    with jax.enable_x64(True):
        assert np.isclose(chi2_cdf(chi2_quantile(probability, dof), dof), probability, rtol=1e-9)


def test_gradients(x64):
    p, step = jnp.asarray(0.9), 1e-6
    difference = (chi2_quantile(p + step, 3) - chi2_quantile(p - step, 3)) / (2 * step)
    assert np.isclose(jax.grad(chi2_quantile)(p, 3), difference, rtol=1e-6)
    assert np.isclose(jax.grad(chi2_quantile)(p, 3), 1 / chi2.pdf(chi2.ppf(0.9, 3), 3))
    assert np.isclose(jax.grad(chi2_cdf)(jnp.asarray(4.0), 3), chi2.pdf(4.0, 3))


def test_gate_holds_its_probability(dtype, rng):  # T-89
    distances = jnp.asarray((rng.normal(size=(20000, 3)) ** 2).sum(1), dtype)
    for probability in (0.5, 0.99):
        inside = gate(distances, 3, probability)
        assert abs(float(inside.mean()) - probability) < 0.012
        arrays = gate(distances, jnp.asarray(3.0, dtype), jnp.asarray(probability, dtype))
        assert np.mean(np.asarray(arrays) != np.asarray(inside)) < 1e-3
        assert np.array_equal(inside, jax.jit(lambda d, p=probability: gate(d, 3, p))(distances))
        assert np.array_equal(inside[:9], jax.vmap(lambda d, p=probability: gate(d, 3, p))(distances[:9]))


def test_degenerate_input(dtype):
    distances = jnp.array([np.nan, np.inf, -1.0, 0.0], dtype)
    assert gate(distances, 2, 0.95).tolist() == [False, False, True, True]
    edges = chi2_quantile(jnp.array([0.0, 1.0, -3.0, 2.0], dtype), 3)
    assert np.isfinite(edges).all() and np.all(np.asarray(edges) >= 0)
    assert np.isfinite(jax.vmap(jax.grad(lambda p: chi2_quantile(p, 3)))(jnp.array([0.0, 1.0], dtype))).all()
    assert np.allclose(chi2_cdf(jnp.array([-1.0, 0.0], dtype), 3), 0.0)
