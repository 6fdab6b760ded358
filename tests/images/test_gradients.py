"""Image derivatives and smoothing against OpenCV and NumPy."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.images.gradients import central_difference, convolve_columns, convolve_rows, scharr, smooth, sobel

SHAPE = (25, 32)


def test_sobel_and_scharr_equal_opencv(rng, dtype):
    image = rng.normal(size=SHAPE).astype(dtype)
    depth = cv2.CV_32F if dtype == np.float32 else cv2.CV_64F
    for got, make, scale in ((sobel(jnp.asarray(image)), cv2.Sobel, 8), (scharr(jnp.asarray(image)), cv2.Scharr, 32)):
        assert got.right.dtype == dtype
        np.testing.assert_allclose(got.right, make(image, depth, 1, 0) / scale, atol=1e-6)
        np.testing.assert_allclose(got.down, make(image, depth, 0, 1) / scale, atol=1e-6)


def test_central_difference_equals_numpy(rng):
    image = rng.normal(size=SHAPE).astype(np.float32)
    got = central_difference(jnp.asarray(image))
    down, right = np.gradient(image)
    np.testing.assert_allclose(got.right[:, 1:-1], right[:, 1:-1], atol=1e-6)
    np.testing.assert_allclose(got.down[1:-1], down[1:-1], atol=1e-6)
    assert float(jnp.abs(got.right[:, 0]).max()) == 0.0


@pytest.mark.parametrize("sigma", [0.8, 2.0])
def test_smooth_equals_opencv(rng, dtype, sigma):
    image = rng.normal(size=SHAPE).astype(dtype)
    got = smooth(jnp.asarray(image), sigma, radius=6)
    assert got.dtype == dtype
    np.testing.assert_allclose(got, cv2.GaussianBlur(image, (13, 13), sigma), atol=1e-5)


def test_smooth_chooses_its_reach_and_keeps_constants():
    np.testing.assert_allclose(smooth(jnp.full((9, 9), 3.0), 1.1), 3.0, rtol=1e-6)
    with pytest.raises(ValueError, match="radius"):
        smooth(jnp.ones((9, 9)), jnp.asarray(1.0))


def test_gradient_by_sigma_equals_finite_differences(rng, x64):
    image = jnp.asarray(rng.normal(size=SHAPE))

    def value(sigma):
        return (smooth(image, sigma, radius=5) ** 2).sum()

    slope = jax.grad(value)(jnp.asarray(1.3))
    h = 1e-6
    want = (value(jnp.asarray(1.3 + h)) - value(jnp.asarray(1.3 - h))) / (2 * h)
    np.testing.assert_allclose(slope, want, rtol=1e-6)


def test_convolutions_equal_numpy(rng):
    image, weights = rng.normal(size=SHAPE).astype(np.float32), rng.normal(size=5).astype(np.float32)
    rows = [np.correlate(np.pad(row, 2, mode="reflect"), weights, "valid") for row in image]
    np.testing.assert_allclose(convolve_rows(jnp.asarray(image), jnp.asarray(weights)), rows, atol=1e-5)
    columns = convolve_columns(jnp.asarray(image.T), jnp.asarray(weights)).T
    np.testing.assert_allclose(columns, rows, atol=1e-5)


def test_jit_vmap_and_eager_agree(rng):
    stack = jnp.asarray(rng.normal(size=(3, *SHAPE)), jnp.float32)
    batched = jax.vmap(sobel)(stack)
    one = sobel(stack[1])
    np.testing.assert_allclose(batched.down[1], one.down, atol=1e-6)
    with jax.disable_jit():
        np.testing.assert_allclose(sobel(stack[1]).right, one.right, atol=1e-6)
