"""Nonlinear scale space against explicit kernels, single steps, and a Gaussian scale space."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage

from jaxloc.features.scale_space.nonlinear import (
    FastExplicitDiffusion,
    NonlinearScaleSpace,
    OperatorSplitting,
    nonlinear_scale_space,
)
from jaxloc.images.diffusion import LARGEST_STEP, Linear, conductance, contrast, diffuse_implicit
from jaxloc.images.gradients import smooth

FULL = NonlinearScaleSpace(octaves=1, reach=1.5)
HALVED = NonlinearScaleSpace.akaze(octaves=2)


@pytest.fixture(scope="module")
def image():
    image = ndimage.gaussian_filter(np.random.default_rng(0).uniform(0, 2000, (88, 96)), 2.0)
    image[:, 48:] += 60.0
    return image


def dilated_kernel(reach):
    """Scharr's kernel between samples `reach` apart, as an array."""
    across, along = np.zeros((2 * reach + 1, 1)), np.zeros((1, 2 * reach + 1))
    across[[0, reach, -1], 0] = 3 / 16, 10 / 16, 3 / 16
    along[0, [0, -1]] = -0.5 / reach, 0.5 / reach
    return across * along


def test_derivatives_equal_plain_kernels(image, x64):
    found = nonlinear_scale_space(jnp.asarray(image), FULL)[0]
    for k, blur in enumerate(FULL.blurs(4)):
        reach = round(FULL.reach * blur)
        layer, kernel = np.asarray(smooth(found.layers[k], 1.0)), dilated_kernel(reach)
        right, down = (ndimage.correlate(layer, m, mode="mirror") for m in (kernel, kernel.T))
        uu, vv, uv = (ndimage.correlate(a, m) for a, m in ((right, kernel), (down, kernel.T), (right, kernel.T)))
        inside = (slice(20, -20), slice(20, -20))
        for ours, theirs in (
            (found.right, right),
            (found.down, down),
            (found.determinant, (FULL.reach * blur) ** 4 * (uu * vv - uv**2)),
        ):
            np.testing.assert_allclose(ours[k][inside], theirs[inside], atol=1e-8 * np.abs(theirs).max())


def test_layers_are_diffused_one_from_the_other(image, x64):  # T-48
    image = jnp.asarray(image)
    found, blurs, edge = nonlinear_scale_space(image, FULL)[0], FULL.blurs(4), contrast(image)
    layer = smooth(image, 1.6)
    np.testing.assert_allclose(found.layers[0], layer)
    for k in range(2):
        time = jnp.asarray(0.5 * (blurs[k + 1] ** 2 - blurs[k] ** 2))
        layer = diffuse_implicit(layer, conductance(layer, edge), time)
        np.testing.assert_allclose(found.layers[k + 1], layer, rtol=1e-9)


@pytest.mark.parametrize("scheme", [OperatorSplitting(), FastExplicitDiffusion()])
def test_steps_sum_to_the_diffusion_times(scheme):  # T-49
    blurs = HALVED.blurs(4)
    times = tuple(0.5 * (after**2 - before**2) for before, after in zip(blurs[:-1], blurs[1:], strict=True))
    steps = scheme.steps(times)
    np.testing.assert_allclose(steps.sum(axis=1), times, rtol=1e-12)
    assert steps.sum() == pytest.approx(0.5 * (blurs[-1] ** 2 - 1.6**2)) and steps.max() > LARGEST_STEP


def test_without_edges_it_is_gaussian(x64):
    """The width of a diffused point is the blur of its layer."""
    options = NonlinearScaleSpace(octaves=1, halved=True, scheme=FastExplicitDiffusion(), conductivity=Linear())
    image = jnp.zeros((81, 81)).at[40, 40].set(1e4)
    u = np.arange(81.0) - 40
    for layer, blur in zip(np.asarray(nonlinear_scale_space(image, options)[0].layers), options.blurs(4), strict=True):
        assert np.sqrt((layer.sum(0) * u**2).sum() / layer.sum()) == pytest.approx(blur, rel=0.02)


def test_edges_are_preserved_and_noise_is_removed(rng):  # T-43
    edge = np.where(np.arange(96) < 48, 60.0, 180.0)[None, :] + 8.0 * rng.normal(size=(88, 96))
    image = jnp.asarray(edge, jnp.float32)
    last = nonlinear_scale_space(image, HALVED)[0].layers[4]
    blurred = smooth(image, HALVED.blurs(4)[4])
    steep, flat = (lambda x: float((x[:, 50] - x[:, 45]).mean())), (lambda x: float(x[8:-8, 8:36].std()))
    assert steep(last) > 1.3 * steep(blurred) and flat(last) < 0.35 * 8.0


def test_number_of_octaves_depends_on_the_shape():
    assert [NonlinearScaleSpace().layout((n, 999)) for n in (30, 90, 170, 999)] == [(1, 4), (1, 8), (1, 12), (1, 16)]
    assert [NonlinearScaleSpace(halved=True).layout((n, 999))[0] for n in (30, 90, 170, 999)] == [1, 2, 3, 4]


def test_gradients_equal_differences(image, x64):
    image, change = jnp.asarray(image[:48, :50]), jnp.asarray(np.random.default_rng(1).normal(size=(48, 50)))
    edge_free = NonlinearScaleSpace(octaves=1, conductivity=Linear())
    run = jax.jit(lambda t: nonlinear_scale_space(image + t * change, edge_free)[0].determinant)
    np.testing.assert_allclose(jax.jvp(run, (0.0,), (1.0,))[1], (run(1e-4) - run(-1e-4)) / 2e-4, rtol=1e-5, atol=1e-5)
