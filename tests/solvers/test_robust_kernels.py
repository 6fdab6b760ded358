import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.solvers import Barron, Cauchy, GemanMcClure, Huber, Quadratic, Tukey

KERNELS = {
    "quadratic": lambda: Quadratic(),
    "huber": lambda: Huber(1.345),
    "cauchy": lambda: Cauchy(2.385),
    "geman_mcclure": lambda: GemanMcClure(3.0),
    "tukey": lambda: Tukey(4.685),
    **{f"barron_{shape}": lambda shape=shape: Barron(shape, 1.7) for shape in (2.0, 1.5, 1.0, 0.0, -2.0, -8.0)},
}
RESIDUALS = np.array([1e-6, 0.01, 0.4, 1.0, 1.3, 1.4, 2.2, 4.0, 4.6, 4.8, 9.0, 100.0])


@pytest.mark.parametrize("name", KERNELS)
def test_weight_is_the_slope_over_the_residual(name, x64):
    kernel = KERNELS[name]()
    r = jnp.asarray(RESIDUALS)
    weight = kernel.weight(r**2)
    slope = jax.vmap(jax.grad(lambda r: kernel.rho(r**2)))(r)
    np.testing.assert_allclose(weight, slope / r, rtol=1e-10, atol=1e-14)
    step = 1e-6 * np.maximum(RESIDUALS, 1.0)
    inner = RESIDUALS > 1e-3
    difference = (
        kernel.rho(jnp.asarray((RESIDUALS + step) ** 2)) - kernel.rho(jnp.asarray((RESIDUALS - step) ** 2))
    ) / (2 * step)
    tolerance = 1e-6 * np.maximum(1.0, np.asarray(kernel.rho(r**2)) / RESIDUALS)
    assert np.all(np.abs(difference - weight * r)[inner] <= tolerance[inner])


@pytest.mark.parametrize("name", KERNELS)
def test_kernel_is_plain_near_zero_and_never_nan(name, dtype):
    kernel = KERNELS[name]()
    kernel = jax.tree.map(lambda x: x.astype(dtype), kernel)
    zero = jnp.zeros((), dtype)
    assert float(kernel.rho(zero)) == 0.0 and abs(float(kernel.weight(zero)) - 1.0) < 1e-6
    small = jnp.asarray(1e-4, dtype)
    np.testing.assert_allclose(kernel.rho(small), 0.5e-4, rtol=1e-3)
    for function in (kernel.rho, kernel.weight):
        assert function(small).dtype == dtype
        for s in (0.0, 1.0, 1e12):
            s = jnp.asarray(s, dtype)
            assert np.isfinite(function(s)) and np.isfinite(jax.grad(function)(s))
            assert np.isfinite(jax.grad(jax.grad(function))(s))


@pytest.mark.parametrize("name", [k for k in KERNELS if k not in ("quadratic", "barron_2.0")])
def test_weights_fall(name, x64):
    weights = np.asarray(KERNELS[name]().weight(jnp.asarray(RESIDUALS) ** 2))
    assert np.all(np.diff(weights) <= 1e-15) and weights[-1] < 0.2


@pytest.mark.parametrize(
    ("shape", "other", "scale_ratio"),
    [(2.0, Quadratic, None), (0.0, Cauchy, np.sqrt(2.0)), (-2.0, GemanMcClure, 2.0)],
)
def test_special_shapes_of_the_general_kernel(shape, other, scale_ratio, x64):
    """Barron's scale differs from the usual ones by a factor: ``rho`` is the same function."""
    squared = jnp.asarray(RESIDUALS) ** 2
    general = Barron(shape, 1.7)
    special = other() if scale_ratio is None else other(1.7 * scale_ratio)
    # At shape 2 the bounded gap of 1e-4 leaves rounding of the logarithm.
    kept = RESIDUALS < 10.0
    np.testing.assert_allclose(general.rho(squared)[kept], special.rho(squared)[kept], rtol=1e-6)
    np.testing.assert_allclose(general.weight(squared)[kept], special.weight(squared)[kept], rtol=1e-6)


def test_general_kernel_of_the_paper(x64):
    """Equation 7 of Barron 2019, away from its special shapes."""
    r, c = RESIDUALS, 1.7
    for shape in (1.5, 1.0, -1.0, -8.0):
        gap = abs(shape - 2.0)
        expected = c**2 * gap / shape * (((r / c) ** 2 / gap + 1.0) ** (shape / 2.0) - 1.0)
        np.testing.assert_allclose(Barron(shape, c).rho(jnp.asarray(r) ** 2), expected, rtol=1e-8, atol=1e-15)


def test_shape_can_be_learned(x64):
    squared = jnp.asarray([0.0, 0.5, 4.0, 50.0])
    for shape in (2.0, 1.9999, 0.0, 1e-4, -1e-4, -2.0, 1.0):
        slope = jax.jacfwd(lambda a: Barron(a, 1.7).rho(squared))(jnp.asarray(shape))
        assert np.all(np.isfinite(slope))
    step = 1e-3
    for shape in (0.0, -2.0, 1.0):
        slope = jax.jacfwd(lambda a: Barron(a, 1.7).rho(squared))(jnp.asarray(shape))
        high, low = (Barron(shape + d, 1.7).rho(squared) for d in (step, -step))
        np.testing.assert_allclose(slope, (high - low) / (2 * step), rtol=2e-3, atol=1e-6)


@pytest.mark.parametrize("name", KERNELS)
def test_widened_scales_the_residual(name, x64):
    """``rho`` of a kernel k times as wide is ``k^2 rho(r / k)``."""
    kernel, squared = KERNELS[name](), jnp.asarray(RESIDUALS) ** 2
    np.testing.assert_allclose(kernel.widened(3.0).rho(squared), 9.0 * kernel.rho(squared / 9.0), rtol=1e-9)
