"""Pyramids against OpenCV; coordinates of levels against the centroid of a blob."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.images.pyramid import from_level, gaussian_pyramid, halve, to_level


@pytest.mark.parametrize("shape", [(40, 60), (37, 51)])
def test_levels_equal_opencv(rng, dtype, shape):
    image = rng.normal(size=shape).astype(dtype)
    levels = gaussian_pyramid(jnp.asarray(image), levels=3)
    want = image
    for level in levels:
        assert level.dtype == dtype
        np.testing.assert_allclose(level, want, atol=1e-5)
        want = cv2.pyrDown(want)


def test_a_blob_lies_where_the_coordinates_say():
    u, v = np.meshgrid(np.arange(96.0), np.arange(80.0))
    blob = np.exp(-((u - 45.3) ** 2 + (v - 37.8) ** 2) / 50)
    for k, level in enumerate(gaussian_pyramid(jnp.asarray(blob, jnp.float32), levels=3)):
        columns, rows = np.meshgrid(np.arange(level.shape[1]), np.arange(level.shape[0]))
        mass = np.asarray(level) / np.asarray(level).sum()
        center = jnp.asarray([[(mass * columns).sum(), (mass * rows).sum()]], jnp.float32)
        np.testing.assert_allclose(from_level(center, k), [[45.3, 37.8]], atol=0.02)
        np.testing.assert_allclose(to_level(jnp.array([[45.3, 37.8]]), k), center, atol=0.02)


def test_too_many_levels_are_refused():
    with pytest.raises(ValueError, match="fewer"):
        gaussian_pyramid(jnp.ones((16, 16)), levels=5)
    with pytest.raises(ValueError, match="fewer"):
        gaussian_pyramid(jnp.ones((16, 16)), levels=0)


def test_gradient_is_the_transpose(rng, x64):
    image, weights = jnp.asarray(rng.normal(size=(20, 30))), jnp.asarray(rng.normal(size=(10, 15)))
    gradient = jax.grad(lambda x: (halve(x) * weights).sum())(image)
    np.testing.assert_allclose((gradient * image).sum(), (halve(image) * weights).sum(), rtol=1e-10)


def test_vmap_equals_loop(rng):
    stack = jnp.asarray(rng.normal(size=(2, 20, 30)), jnp.float32)
    np.testing.assert_allclose(jax.vmap(halve)(stack)[1], halve(stack[1]), atol=1e-6)
