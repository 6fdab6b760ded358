"""Sliding windows of directions against a plain search over fine steps."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.features.scale_space.orientation import dominant_direction


def plain(right, down, width):
    """Windows that begin every hundredth of a degree."""
    angle, best = np.arctan2(down, right), (-1.0, 0.0)
    for start in np.deg2rad(np.arange(0, 360, 0.01)):
        within = (angle - start) % (2 * np.pi) < width
        total = right[within].sum(), down[within].sum()
        best = max(best, (np.hypot(*total), np.arctan2(total[1], total[0]) % (2 * np.pi)))
    return best[1]


def test_no_window_holds_more(dtype, rng):  # T-38
    right, down = rng.normal(size=(2, 5, 30)).astype(dtype) + np.array([0.3, -0.2], dtype)[:, None, None]
    found = dominant_direction(jnp.asarray(right), jnp.asarray(down))
    assert found.ok.all() and found.angle.dtype == dtype
    for k in range(5):
        assert float(found.angle[k]) == pytest.approx(plain(right[k], down[k], np.pi / 3), abs=1e-4)


def test_it_turns_with_the_slopes(x64, rng):
    slopes = rng.normal(size=(5, 30)) + 1j * rng.normal(size=(5, 30))
    both = slopes, slopes * np.exp(1.234j)
    plain, turned = (
        np.asarray(dominant_direction(*(jnp.asarray(f(x)) for f in (np.real, np.imag))).angle) for x in both
    )
    np.testing.assert_allclose(np.exp(1j * (turned - plain)), np.exp(1.234j), atol=1e-9)


def test_derivatives_and_nothing_at_all(x64, rng):
    right, down, change = (jnp.asarray(x) for x in rng.normal(size=(3, 5, 30)))
    run = jax.jit(lambda t: dominant_direction(right + t * change, down).angle)
    np.testing.assert_allclose(jax.jvp(run, (0.0,), (1.0,))[1], (run(1e-6) - run(-1e-6)) / 2e-6, atol=1e-6)
    none = jnp.zeros((5, 30))
    assert not dominant_direction(none, none).ok.any()
    assert np.isfinite(jax.grad(lambda x: dominant_direction(x, none).angle.sum())(none)).all()
