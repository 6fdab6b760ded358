"""The sweet spot of the update rate: formulas against numeric minimization, a simulation against the formulas."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from jaxloc.evaluation import update_rate
from jaxloc.evaluation.update_rate import PlainSum, Quadrature

SIGMA, K, WAY = 2e-3, 3e-4, 25.0
COMBINATIONS = {
    "plain": (PlainSum(), lambda d: SIGMA * (WAY / d) ** 0.5 + K * WAY * d),
    "quadrature": (Quadrature(), lambda d: (SIGMA**2 * WAY / d + (K * WAY * d) ** 2) ** 0.5),
}


@pytest.mark.parametrize("name", COMBINATIONS)
def test_formulas_agree_with_a_numeric_minimum(x64, name):
    combination, curve = COMBINATIONS[name]
    best = float(update_rate.best_spacing(sigma=SIGMA, k=K, way=WAY, combination=combination))
    found = minimize_scalar(curve, bounds=(1e-3, 10.0), method="bounded", options={"xatol": 1e-9})
    assert best == pytest.approx(found.x, rel=1e-5)
    spacing = jnp.array([0.5 * best, best, 2.0 * best])
    errors = update_rate.expected_error(spacing, sigma=SIGMA, k=K, way=WAY, combination=combination)
    np.testing.assert_allclose(errors, [curve(d) for d in np.asarray(spacing)], rtol=1e-12)
    slope = jax.grad(lambda d: update_rate.expected_error(d, sigma=SIGMA, k=K, way=WAY, combination=combination))
    assert abs(float(slope(jnp.asarray(best)))) < 1e-12


def test_quadrature_moves_the_optimum_by_the_cube_root_of_two():
    plain, square = (
        update_rate.best_spacing(sigma=SIGMA, k=K, way=WAY, combination=c) for c in (PlainSum(), Quadrature())
    )
    assert float(square / plain) == pytest.approx(2.0 ** (1.0 / 3.0), rel=1e-5)


@pytest.fixture(scope="module")
def simulated():
    """Spacings, and what 1500 drives with each of them end with."""
    counts = np.unique(np.rint(WAY / np.geomspace(0.45, 3.6, 18)))
    drift = update_rate.simulate_drift(
        jnp.asarray(counts, jnp.float32),
        sigma=SIGMA,
        k=K,
        way=WAY,
        key=jax.random.key(1),
        most=int(counts[-1]),
        runs=1500,
    )
    return jnp.asarray(WAY / counts, jnp.float32), drift


@pytest.mark.parametrize("name", COMBINATIONS)
def test_simulated_drives_are_best_at_the_formulas_optimum(name, simulated):
    combination, (spacing, drift) = COMBINATIONS[name][0], simulated
    best = float(update_rate.best_spacing(sigma=SIGMA, k=K, way=WAY, combination=combination))
    assert 1.5 * spacing[-1] < best < spacing[0] / 1.5
    found = float(update_rate.find_minimum(spacing, combination.combine(drift.deviation, drift.offset)))
    assert found == pytest.approx(best, rel=0.1)


def test_dtype_is_kept(dtype):
    drift = update_rate.simulate_drift(
        jnp.array([2.0, 3.0], dtype), sigma=0.1, k=0.1, way=1.0, key=jax.random.key(0), most=3, runs=10
    )
    assert drift.deviation.dtype == dtype and drift.offset.dtype == dtype
    assert update_rate.expected_error(jnp.ones(2, dtype), sigma=1.0, k=1.0, way=1.0).dtype == dtype
