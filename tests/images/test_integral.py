"""Integral images against NumPy's sums, exact where numbers are whole."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.images.integral import box_sums, filter_boxes, integral


def boxes_of(rng, shape, count=40):
    rows, columns = (np.sort(rng.integers(0, n + 1, (count, 2)), axis=1) for n in shape)
    return np.stack([rows[:, 0], columns[:, 0], rows[:, 1], columns[:, 1]], axis=1)


def plain(image, boxes):
    return np.array([image[a:c, b:d].sum(dtype=image.dtype) for a, b, c, d in boxes])


@pytest.mark.parametrize("kind", [np.uint8, np.int16, np.int32])
def test_sums_of_integers_are_exact(rng, kind):  # T-36
    image = rng.integers(0, 120, (30, 41)).astype(kind)
    boxes = boxes_of(rng, image.shape)
    found = box_sums(integral(jnp.asarray(image)), jnp.asarray(boxes, jnp.int32))
    assert found.tolist() == plain(image.astype(np.int64), boxes).tolist()


def test_sums_of_floats_equal_numpy(dtype, rng):
    image = rng.uniform(-50, 200, (30, 41)).astype(dtype)
    boxes = boxes_of(rng, image.shape)
    found = box_sums(integral(jnp.asarray(image)), jnp.asarray(boxes, jnp.int32))
    assert found.dtype == dtype
    tolerance = 100 * image.size * np.finfo(dtype).eps
    np.testing.assert_allclose(found, plain(image.astype(float), boxes), atol=tolerance)


def test_sums_that_wrap_around_are_exact(rng):
    """An image whose sum exceeds 31 bits; the boxes' sums do not."""
    image = rng.integers(0, 2**30, (30, 41)).astype(np.int32)
    boxes = np.stack([r := np.arange(29), c := np.arange(29) + 5, r + 1, c + 1], axis=1)
    found = box_sums(integral(jnp.asarray(image)), jnp.asarray(boxes, jnp.int32))
    assert found.tolist() == plain(image.astype(np.int64), boxes).tolist()


def test_boxes_outside_and_empty_ones(rng):
    image = rng.integers(0, 9, (30, 41)).astype(np.int32)
    boxes = jnp.array([[-5, -5, 99, 99], [3, 3, 3, 9], [9, 9, 4, 12], [40, 2, 50, 9], [-3, 2, 2, 4]], jnp.int32)
    assert box_sums(integral(jnp.asarray(image)), boxes).tolist() == [image.sum(), 0, 0, 0, image[:2, 2:4].sum()]


def row_of_pixels(sums, rows):
    return (sums[rows + 1, 1:] - sums[rows, 1:] - sums[rows + 1, :-1] + sums[rows, :-1],)


def test_large_pictures_keep_every_gray_level(rng):
    """Sums of float32 would be off by whole gray levels after a million pixels."""
    image = rng.integers(0, 256, (1100, 1000)).astype(np.float32)
    rows = jnp.array([700, 1099])
    assert (filter_boxes(row_of_pixels, 4, jnp.asarray(image), rows)[0] == image[[700, 1099]]).all()
    assert np.abs(row_of_pixels(integral(jnp.asarray(image)), rows)[0] - image[[700, 1099]]).max() > 1.0


def test_derivatives_are_those_of_the_filter(dtype, rng):
    image, change = (jnp.asarray(rng.uniform(0, 255, (30, 41)), dtype) for _ in range(2))
    run = lambda x: filter_boxes(row_of_pixels, 4, x, jnp.array([7]))[0]  # noqa: E731
    value, slope = jax.jvp(run, (image,), (change,))
    assert value.dtype == slope.dtype == dtype
    np.testing.assert_allclose(value[0], image[7], atol=1e-4)
    np.testing.assert_allclose(slope[0], change[7], atol=0.1 if dtype == np.float32 else 1e-9)
    back = jax.grad(lambda x: run(x)[0, 5])(image)
    np.testing.assert_allclose(back, np.zeros(image.shape) + (np.indices(image.shape).T == [7, 5]).all(2).T, atol=1e-5)


@pytest.mark.parametrize("value", [0.0, 1e-30, 1e30])
def test_any_brightness_is_finite(value):
    image = jnp.full((8, 9), value, jnp.float32)
    np.testing.assert_allclose(filter_boxes(row_of_pixels, 4, image, jnp.array([3]))[0], value, rtol=1e-6, atol=1e-25)
