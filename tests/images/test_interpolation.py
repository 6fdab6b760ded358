"""Sampling between pixels against SciPy, OpenCV and Keys' formula."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from jaxloc.images.interpolation import Bicubic, Bilinear, inside_image, sample

H, W, N = 23, 31, 40


def make(rng, dtype=np.float32):
    image = rng.normal(size=(H, W)).astype(dtype)
    uv = np.stack([rng.uniform(0, W - 1, N), rng.uniform(0, H - 1, N)], axis=1).astype(dtype)
    return image, uv


def keys(image, uv, a):
    """Keys' kernel written as a function of distance, summed pixel by pixel, borders repeated."""

    def kernel(x):
        x = abs(x)
        if x <= 1:
            return (a + 2) * x**3 - (a + 3) * x**2 + 1
        return a * x**3 - 5 * a * x**2 + 8 * a * x - 4 * a if x < 2 else 0.0

    values = []
    for u, v in uv.astype(float):
        total = 0.0
        for row in range(int(v) - 2, int(v) + 4):
            for column in range(int(u) - 2, int(u) + 4):
                pixel = image[min(max(row, 0), H - 1), min(max(column, 0), W - 1)]
                total += kernel(u - column) * kernel(v - row) * pixel
        values.append(total)
    return np.array(values)


def test_bilinear_equals_scipy(rng, dtype):
    image, uv = make(rng, dtype)
    uv[:3] = [[0, 0], [W - 1, H - 1], [W - 1, 0.5]]
    got = sample(jnp.asarray(image), jnp.asarray(uv))
    assert got.values.dtype == dtype and bool(got.inside.all())
    want = ndimage.map_coordinates(image, [uv[:, 1], uv[:, 0]], order=1, mode="nearest")
    np.testing.assert_allclose(got.values, want, atol=1e-5 if dtype == np.float32 else 1e-12)


@pytest.mark.parametrize("a", [-0.5, -0.75])
def test_bicubic_equals_keys(rng, a):
    image, uv = make(rng)
    got = sample(jnp.asarray(image), jnp.asarray(uv), method=Bicubic(a))
    np.testing.assert_allclose(got.values, keys(image, uv, a), atol=2e-5)


def test_bicubic_equals_opencv(rng):
    image, uv = make(rng)
    # OpenCV rounds coordinates to 1/32 px and its own border differs.
    uv = (np.clip(np.round(uv * 32) / 32, 2, [W - 4, H - 4])).astype(np.float32)
    got = sample(jnp.asarray(image), jnp.asarray(uv), method=Bicubic(-0.75))
    want = cv2.remap(image, uv[:, 0].copy(), uv[:, 1].copy(), cv2.INTER_CUBIC).ravel()
    np.testing.assert_allclose(got.values, want, atol=1e-5)


@settings(deadline=None, max_examples=10)
@given(st.floats(-5, 5), st.floats(-5, 5), st.floats(-1, 1))
def test_polynomials_are_reproduced(slope_u, slope_v, bend):
    u, v = np.meshgrid(np.arange(W), np.arange(H))
    uv = np.random.default_rng(1).uniform(3, H - 4, (N, 2)).astype(np.float32)
    plane, bowl = slope_u * u + slope_v * v, bend * 0.1 * u * u
    got = sample(jnp.asarray(plane, jnp.float32), jnp.asarray(uv))
    np.testing.assert_allclose(got.values, slope_u * uv[:, 0] + slope_v * uv[:, 1], atol=1e-3)
    got = sample(jnp.asarray(plane + bowl, jnp.float32), jnp.asarray(uv), method=Bicubic())
    want = slope_u * uv[:, 0] + slope_v * uv[:, 1] + bend * 0.1 * uv[:, 0] ** 2
    np.testing.assert_allclose(got.values, want, atol=1e-3)


def test_channels_are_sampled_alike(rng):  # K-10
    image, uv = make(rng)
    stack = np.stack([image, 2 * image, image**2], axis=-1)
    got = sample(jnp.asarray(stack), jnp.asarray(uv), method=Bicubic())
    for channel in range(3):
        alone = sample(jnp.asarray(stack[..., channel]), jnp.asarray(uv), method=Bicubic())
        np.testing.assert_allclose(got.values[:, channel], alone.values, atol=1e-6)


@pytest.mark.parametrize("method", [Bilinear(), Bicubic()])
def test_outside_is_zero_flagged_and_without_gradient(rng, method):
    image, uv = make(rng)
    uv[0], uv[1], uv[2], uv[3] = [-0.01, 3], [W - 0.9, 2], [np.nan, 4], [4, np.inf]
    image, uv = jnp.asarray(image), jnp.asarray(uv)
    got = sample(image, uv, method=method)
    assert got.inside.tolist() == [False] * 4 + [True] * (N - 4)
    assert got.values[:4].tolist() == [0.0] * 4
    by_image, by_uv = jax.grad(lambda i, x: sample(i, x, method=method).values[:4].sum(), argnums=(0, 1))(image, uv)
    assert float(jnp.abs(by_image).max()) == 0.0
    assert float(jnp.abs(by_uv).max()) == 0.0
    by_all = jax.grad(lambda i: (sample(i, uv, method=method).values ** 2).sum())(image)
    assert bool(jnp.isfinite(by_all).all())


@pytest.mark.parametrize("method", [Bilinear(), Bicubic()])
def test_gradients_equal_finite_differences(rng, x64, method):
    image, uv = make(rng, np.float64)
    uv = np.floor(uv) + np.clip(uv - np.floor(uv), 0.1, 0.9)
    uv = np.minimum(uv, [W - 1.1, H - 1.1])
    weights = rng.normal(size=N)

    def value(image, uv):
        return (sample(jnp.asarray(image), jnp.asarray(uv), method=method).values * weights).sum()

    by_image, by_uv = jax.grad(value, argnums=(0, 1))(jnp.asarray(image), jnp.asarray(uv))
    step = rng.normal(size=uv.shape) * 1e-6
    slope = (value(image, uv + step) - value(image, uv - step)) / 2
    np.testing.assert_allclose((by_uv * step).sum(), slope, rtol=1e-5)
    step = rng.normal(size=image.shape)
    np.testing.assert_allclose((by_image * step).sum(), value(image + step, uv) - value(image, uv), rtol=1e-8)


def test_jit_vmap_and_eager_agree(rng):
    image, uv = make(rng)
    image, uv = jnp.asarray(image), jnp.asarray(uv)
    jitted = sample(image, uv, method=Bicubic()).values
    with jax.disable_jit():
        np.testing.assert_allclose(sample(image, uv, method=Bicubic()).values, jitted, atol=1e-5)
    batched = jax.vmap(lambda x: sample(image, x[None], method=Bicubic()).values[0])(uv)
    np.testing.assert_allclose(batched, jitted, atol=1e-5)


def test_tiny_images():
    assert sample(jnp.ones((1, 1)), jnp.zeros((1, 2)), method=Bicubic()).values.tolist() == [1.0]
    assert inside_image(jnp.zeros((1, 2)), (1, 1)).tolist() == [True]
