"""Scale space against SciPy, and what its equations say of blobs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage

from jaxloc.features.scale_space import ScaleSpace, difference_of_gaussians, laplacian, octaves


def blob(sigma, size=81, height=100.0):
    v, u = np.mgrid[:size, :size] - size // 2
    return height * np.exp(-(u**2 + v**2) / (2.0 * sigma**2))


@pytest.mark.parametrize("sigma", [1.2, 2.0, 4.0])
def test_laplacian_equals_scipy(dtype, rng, sigma):
    image = rng.uniform(0, 255, (40, 50))
    ours = laplacian(jnp.asarray(image, dtype), sigma)
    theirs = sigma**2 * ndimage.gaussian_laplace(image, sigma, mode="mirror", truncate=4.0)
    assert ours.dtype == dtype
    # SciPy does not correct what cutting the kernel leaves: a multiple of the blurred image.
    theirs -= np.mean(theirs - np.asarray(ours))
    np.testing.assert_allclose(ours, theirs, rtol=0.01, atol=0.3 if sigma < 2 else 0.1)


def test_response_to_a_blob_does_not_depend_on_its_size(x64):  # T-27
    for size in (2.0, 3.0, 5.0):
        responses = {s: float(laplacian(jnp.asarray(blob(size)), s)[40, 40]) for s in (0.8 * size, size, 1.25 * size)}
        # -2 t s^2 / (t + s^2)^2 with t = s^2: half of the height, and the extremum over scales.
        assert responses[size] == pytest.approx(-50.0, rel=5e-3)
        assert min(responses, key=responses.get) == size


def test_difference_nears_the_laplacian(x64):  # T-28: ratio -> 1 as k -> 1
    image = jnp.asarray(blob(4.0))
    misses = []
    for ratio in (1.4, 1.2, 1.1, 1.05):
        share = difference_of_gaussians(image, 3.0, ratio)[40, 40] / ((ratio - 1.0) * laplacian(image, 3.0)[40, 40])
        misses.append(abs(float(share) - 1.0))
    assert misses == sorted(misses, reverse=True) and misses[-1] < 0.03


def test_octaves_have_the_blur_they_say(x64):
    """A point that the camera has blurred already keeps the variance of each layer."""
    options = ScaleSpace(doubled=False)
    image = jnp.asarray(blob(0.8, size=64))
    for octave in octaves(image, ScaleSpace(doubled=False, camera_sigma=0.8))[:2]:
        v, u = np.mgrid[: octave.layers.shape[1], : octave.layers.shape[2]]
        for layer, sigma in zip(np.asarray(octave.layers), options.blurs(), strict=True):
            mass = layer.sum()
            variance = (layer * u**2).sum() / mass - ((layer * u).sum() / mass) ** 2
            # Sampling and cutting the kernels cost a little.
            assert np.sqrt(variance) == pytest.approx(sigma, rel=0.02)


def test_gradient(x64, rng):
    image, change = jnp.asarray(rng.uniform(0, 255, (20, 24))), jnp.asarray(rng.normal(size=(20, 24)))
    run = jax.jit(lambda t: octaves(image + t * change, ScaleSpace())[0].differences[1])
    slope = jax.jvp(run, (0.0,), (1.0,))[1]
    np.testing.assert_allclose(slope, (run(1e-3) - run(-1e-3)) / 2e-3, atol=1e-8)
