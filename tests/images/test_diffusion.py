"""Nonlinear diffusion: sums of steps, both schemes against each other and matrices, edges against a Gaussian."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

from jaxloc.images.diffusion import (
    LARGEST_STEP,
    Exponential,
    Linear,
    PeronaMalik,
    Weickert,
    conductance,
    contrast,
    diffuse,
    diffuse_explicit,
    diffuse_implicit,
    fed_steps,
)
from jaxloc.images.gradients import smooth


@pytest.mark.parametrize("time", [0.1, 0.25, 1.0, 5.0, 12.8, 100.0, 1e4])
@pytest.mark.parametrize("cycles", [1, 4])
def test_steps_sum_to_the_time_exactly(time, cycles):  # T-49
    steps = fed_steps(time, cycles=cycles)
    assert sum(steps) == pytest.approx(time / cycles, rel=1e-14) and min(steps) > 0
    # As many explicit steps would cover n tau only.
    assert len(steps) <= np.sqrt(3 * time / cycles / LARGEST_STEP + 0.25) + 0.5 + 1e-9
    assert len(steps) < 3 or max(steps) > LARGEST_STEP


@pytest.mark.parametrize("arguments", [(0.0, {}), (1.0, {"largest": -1.0}), (1.0, {"cycles": 0})])
def test_steps_need_positive_numbers(arguments):
    with pytest.raises(ValueError, match="positive"):
        fed_steps(arguments[0], **arguments[1])


def operator(g):
    """``div(g grad)`` as a matrix."""
    height, width = g.shape
    matrix = np.zeros((g.size, g.size))
    for i in range(height):
        for j in range(width):
            for a, b in ((i + 1, j), (i, j + 1)):
                if a < height and b < width:
                    p, q, flow = i * width + j, a * width + b, 0.5 * (g[i, j] + g[a, b])
                    matrix[p, q] += flow
                    matrix[q, p] += flow
                    matrix[p, p] -= flow
                    matrix[q, q] -= flow
    return matrix


def test_both_schemes_near_the_exact_solution(x64, rng):  # T-48: they agree as both refine
    image, g = rng.uniform(0, 255, (7, 9)), rng.uniform(0.05, 1.0, (7, 9))
    exact = (expm(3.0 * operator(g)) @ image.ravel()).reshape(image.shape)
    explicit, implicit, apart = [], [], []
    for cycles in (1, 4, 16, 64):
        steps = np.tile(fed_steps(3.0, cycles=cycles), cycles)
        fed = diffuse_explicit(jnp.asarray(image), jnp.asarray(g), jnp.asarray(steps))
        aos = jnp.asarray(image)
        for _ in range(cycles):
            aos = diffuse_implicit(aos, jnp.asarray(g), jnp.array(3.0 / cycles))
        explicit.append(np.abs(fed - exact).max())
        implicit.append(np.abs(aos - exact).max())
        apart.append(np.abs(fed - aos).max())
    for errors in (explicit, implicit, apart):
        assert errors == sorted(errors, reverse=True)
    # First order both.
    assert implicit[-1] < 0.35 * implicit[-2] and explicit[-1] < 0.5 * explicit[-2] and apart[-1] < 2.0


def test_implicit_step_solves_its_equations(x64, rng):
    image, g = rng.uniform(0, 255, (6, 5)), rng.uniform(0.0, 1.0, (6, 5))
    whole, down = operator(g), np.zeros((30, 30))
    for p in range(30):
        for q in range(30):
            if p != q and p % 5 == q % 5:
                down[p, q] = whole[p, q]
    down -= np.diag(down.sum(1))
    right = whole - down
    expected = sum(np.linalg.solve(np.eye(30) - 2 * 20.0 * axis, image.ravel()) for axis in (down, right)) / 2
    ours = diffuse_implicit(jnp.asarray(image), jnp.asarray(g), jnp.array(20.0))
    np.testing.assert_allclose(ours.ravel(), expected, rtol=1e-10)


def test_without_edges_it_is_nearly_a_gaussian(x64):
    spot = jnp.zeros((61, 61)).at[30, 30].set(1000.0)
    ours = diffuse(spot, sigma=4.0, kind=Linear())
    np.testing.assert_allclose(ours, smooth(spot, 4.0, radius=20), atol=0.1 * float(ours.max()))


@pytest.mark.slow
def test_edges_stay_where_noise_goes(rng):  # T-43
    edge = np.where(np.arange(80) < 40, 60.0, 180.0)[None, :] + 8.0 * rng.normal(size=(60, 80))
    edge = jnp.asarray(edge, jnp.float32)
    sharp = diffuse(edge, sigma=3.0)
    flat = lambda image: float(jnp.std(image[8:-8, 8:30]))  # noqa: E731
    steep = lambda image: float(jnp.mean(image[8:-8, 40] - image[8:-8, 39]))  # noqa: E731
    # The Gaussian that leaves as much noise.
    sigma = min(np.arange(0.5, 4.0, 0.1), key=lambda s: abs(flat(smooth(edge, float(s))) - flat(sharp)))
    assert steep(sharp) > 3.0 * steep(smooth(edge, float(sigma)))


@pytest.mark.parametrize("kind", [PeronaMalik(), Exponential(), Weickert(), Linear()])
def test_brightness_is_kept_and_nothing_overshoots(dtype, rng, kind):
    image = jnp.asarray(rng.uniform(0, 255, (24, 31)), dtype)
    smoothed = diffuse(image, sigma=3.0, kind=kind)
    assert smoothed.dtype == dtype
    np.testing.assert_allclose(smoothed.mean(), image.mean(), rtol=1e-5)
    assert image.min() - 1.0 < smoothed.min() and smoothed.max() < image.max() + 1.0
    g = conductance(image, contrast(image), kind=kind)
    assert 0.0 <= g.min() and g.max() <= 1.0


def test_gradients_equal_differences(x64, rng):
    image, change = jnp.asarray(rng.uniform(0, 255, (12, 14))), jnp.asarray(rng.normal(size=(12, 14)))
    edge = contrast(image)

    @jax.jit
    def run(t):
        moved = image + t * change
        g = conductance(moved, edge)
        return diffuse_explicit(moved, g, jnp.asarray(fed_steps(4.0))) + diffuse_implicit(moved, g, jnp.array(4.0))

    slope = jax.jvp(run, (0.0,), (1.0,))[1]
    np.testing.assert_allclose(slope, (run(1e-4) - run(-1e-4)) / 2e-4, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("value", [0.0, 120.0, np.nan])
def test_blank_images(value):
    slope = jax.grad(lambda image: jnp.sum(diffuse(image, sigma=2.0) ** 2))(jnp.full((16, 20), value, jnp.float32))
    assert np.isfinite(slope).all()
    assert float(contrast(jnp.full((16, 20), value, jnp.float32))) == 1.0
