"""Extrema of stacks: exact on paraboloids, sorted out by contrast and shape."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.features.scale_space import ExtremumTest, find_extrema

SHAPE = (5, 24, 30)


def paraboloid(center, curvature=(1.0, 1.0, 1.0), height=9.0, twist=0.0):
    s, v, u = np.meshgrid(*(np.arange(n) for n in SHAPE), indexing="ij")
    ds, dv, du = s - center[0], v - center[1], u - center[2]
    return height - curvature[0] * ds**2 - curvature[1] * dv**2 - curvature[2] * du**2 - twist * du * dv


def first(stack, **options):
    test = ExtremumTest(options.pop("least_value", 1.0), **options)
    return find_extrema(jnp.asarray(stack), test, capacity=6)


@pytest.mark.parametrize("center", [(2.2, 9.4, 11.7), (1.6, 12.49, 20.0), (2.0, 8.0, 8.0)])
def test_exact_on_paraboloids(dtype, center):  # T-29, T-30
    found = first(paraboloid(center, (1.0, 2.0, 1.5), twist=0.5).astype(dtype))
    assert found.valid.tolist() == [True] + 5 * [False] and found.place.dtype == dtype
    np.testing.assert_allclose(found.place[0], center, atol=1e-4)
    assert float(found.value[0]) == pytest.approx(9.0, abs=1e-4)


def test_all_extrema_equal_a_plain_search(x64, rng):
    """Against SciPy's maxima, with the test of shape off."""
    from scipy.ndimage import maximum_filter, minimum_filter

    stack = rng.normal(size=SHAPE)
    extreme = (stack == maximum_filter(stack, 3)) & (stack > 0.25) | (stack == minimum_filter(stack, 3)) & (
        stack < -0.25
    )
    inner = extreme[1:-1, 5:-5, 5:-5].sum()
    found = find_extrema(jnp.asarray(stack), ExtremumTest(0.5, 1e9), capacity=400)
    # Some leave the stack or never settle when they are moved.
    assert 0.2 * inner < int(found.valid.sum()) <= inner


def test_flat_extrema_are_those_of_each_layer(x64, rng):
    """Layers do not see each other, and the first and the last count."""
    stack = np.stack(
        [paraboloid((2.0, 9.4, 11.7))[2], np.zeros(SHAPE[1:]), paraboloid((2.0, 12.2, 20.4), height=5.0)[2]]
    )
    found = first(stack, within_layer=True)
    assert found.valid.tolist() == [True, True] + 4 * [False]
    np.testing.assert_allclose(found.place[:2], [[0.0, 9.4, 11.7], [2.0, 12.2, 20.4]], atol=1e-9)
    np.testing.assert_allclose(found.value[:2], [9.0, 5.0], atol=1e-9)
    noise = rng.normal(size=SHAPE)
    test = ExtremumTest(0.5, 1e9, within_layer=True)
    together = find_extrema(jnp.asarray(noise), test, capacity=400)
    alone = [find_extrema(jnp.asarray(layer[None]), test, capacity=400) for layer in noise]
    assert int(together.valid.sum()) == sum(int(found.valid.sum()) for found in alone) > 0


def test_faint_ones_and_edges_are_dropped():  # T-31, T-32
    center = (2.2, 9.4, 11.7)
    assert not first(paraboloid(center, height=0.9)).valid.any()
    assert not first(paraboloid(center, (1.0, 0.05, 1.0))).valid.any()
    assert first(paraboloid(center, (1.0, 0.2, 1.0))).valid[0]
    assert first(-paraboloid(center)).valid[0] and not first(-paraboloid(center), minima=False).valid.any()


def test_gradients_equal_differences(x64, rng):
    stack, change = paraboloid((2.2, 9.4, 11.7)), rng.normal(size=SHAPE)
    run = jax.jit(lambda t: first(stack + t * change).place[0])
    np.testing.assert_allclose(jax.jacfwd(run)(0.0), (run(1e-6) - run(-1e-6)) / 2e-6, atol=1e-7)


@pytest.mark.parametrize("stack", [np.zeros(SHAPE), np.ones(SHAPE), np.full(SHAPE, np.nan)], ids=["zero", "one", "nan"])
def test_nothing_stands_out(dtype, stack):
    def total(x):
        found = first(x)
        return jnp.sum(found.place), found

    (_, found), slope = jax.value_and_grad(total, has_aux=True)(jnp.asarray(stack, dtype))
    assert not found.valid.any() and np.isfinite(found.place).all() and np.isfinite(slope).all()
