"""Patches against pixel-by-pixel sampling and OpenCV."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.images.interpolation import Bicubic, Bilinear, sample
from jaxloc.images.patches import extract

H, W, N = 30, 41, 25


def make(rng, dtype=np.float32):
    image = rng.normal(size=(H, W)).astype(dtype)
    return image, np.stack([rng.uniform(4, W - 5, N), rng.uniform(3, H - 4, N)], axis=1).astype(dtype)


@pytest.mark.parametrize("method", [Bilinear(), Bicubic()])
@pytest.mark.parametrize("size", [(7, 9), (4, 6)])
def test_equals_sampling_each_pixel(rng, dtype, method, size):
    image, uv = make(rng, dtype)
    uv[:3] = [[4, 3], [W - 5, H - 4], [10, 12]]
    got = extract(jnp.asarray(image), jnp.asarray(uv), size=size, method=method)
    assert got.values.dtype == dtype and bool(got.inside.all())
    rows, columns = np.arange(size[0]) - (size[0] - 1) / 2, np.arange(size[1]) - (size[1] - 1) / 2
    for point, patch in zip(uv[:12], got.values, strict=False):
        grid = np.stack(np.meshgrid(point[0] + columns, point[1] + rows), axis=-1).reshape(-1, 2).astype(dtype)
        want = sample(jnp.asarray(image), jnp.asarray(np.clip(grid, 0, [W - 1, H - 1])), method=method).values
        np.testing.assert_allclose(patch.reshape(-1), want, atol=2e-5)


def test_equals_opencv(rng):
    image, uv = make(rng)
    got = extract(jnp.asarray(image), jnp.asarray(uv), size=7)
    for point, patch in zip(uv, got.values, strict=True):
        np.testing.assert_allclose(patch, cv2.getRectSubPix(image, (7, 7), point.tolist()), atol=1e-4)


def test_patches_that_leave_the_image_are_zero_and_flagged(rng):
    image, uv = make(rng)
    uv[:4] = [[2.9, 10], [10, H - 3.9], [np.nan, 5], [W + 50, 5]]
    got = extract(jnp.asarray(image), jnp.asarray(uv), size=7)
    assert got.inside.tolist() == [False] * 4 + [True] * (N - 4)
    assert float(jnp.abs(got.values[:4]).max()) == 0.0
    gradient = jax.grad(lambda x: extract(jnp.asarray(image), x, size=7).values.sum())(jnp.asarray(uv))
    assert bool(jnp.isfinite(gradient).all()) and float(jnp.abs(gradient[:4]).max()) == 0.0
    kept = extract(jnp.asarray(image), jnp.asarray(uv[4:]), size=7)
    np.testing.assert_array_equal(got.values[4:], kept.values)


def test_a_patch_as_large_as_the_image(rng):
    image = jnp.asarray(rng.normal(size=(5, 7)), jnp.float32)
    got = extract(image, jnp.array([[3.0, 2.0]]), size=(5, 7), method=Bicubic())
    np.testing.assert_allclose(got.values[0], image, atol=1e-6)
    with pytest.raises(ValueError, match="does not fit"):
        extract(image, jnp.array([[3.0, 2.0]]), size=7)


def test_gradients_equal_finite_differences(rng, x64):
    image, uv = make(rng, np.float64)
    uv = np.floor(uv) + 0.1 + 0.8 * (uv - np.floor(uv))
    weights = jnp.asarray(rng.normal(size=(N, 7, 7)))

    def value(image, uv):
        return (extract(jnp.asarray(image), jnp.asarray(uv), size=7, method=Bicubic()).values * weights).sum()

    by_image, by_uv = jax.grad(value, argnums=(0, 1))(jnp.asarray(image), jnp.asarray(uv))
    step = 1e-6 * rng.normal(size=uv.shape)
    np.testing.assert_allclose((by_uv * step).sum(), (value(image, uv + step) - value(image, uv - step)) / 2, rtol=1e-5)
    step = rng.normal(size=image.shape)
    np.testing.assert_allclose((by_image * step).sum(), value(image + step, uv) - value(image, uv), rtol=1e-8)


def test_vmap_over_images(rng):
    image, uv = make(rng)
    stack = jnp.stack([jnp.asarray(image), 2.0 * jnp.asarray(image)])
    got = jax.vmap(lambda x: extract(x, jnp.asarray(uv), size=7).values)(stack)
    np.testing.assert_allclose(got[1], 2.0 * extract(stack[0], jnp.asarray(uv), size=7).values, atol=1e-5)
