"""Corner responses against OpenCV and NumPy's eigenvalues."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.features.harris import Box, GaussianWindow, classify, harris, refine_peaks, shi_tomasi, structure_tensor
from jaxloc.images import gradients

SHAPE = (34, 45)


def textured(rng, dtype=np.float32):
    return cv2.GaussianBlur(rng.uniform(0, 255, SHAPE), (5, 5), 1.0).astype(dtype)


@pytest.mark.parametrize("size", [3, 5])
def test_equal_opencv(rng, dtype, size):  # T-25, T-26
    image = textured(rng, dtype)
    response = harris(jnp.asarray(image), k=0.06, window=Box(size))
    smaller = shi_tomasi(jnp.asarray(image), window=Box(size))
    assert response.dtype == smaller.dtype == dtype
    single, inner = image.astype(np.float32), (slice(4, -4),) * 2
    want = cv2.cornerHarris(single, size, 3, 0.06)
    np.testing.assert_allclose(16 * response[inner], want[inner], atol=1e-5 * np.abs(want).max())
    want = cv2.cornerMinEigenVal(single, size, ksize=3)
    np.testing.assert_allclose(4 * smaller[inner], want[inner], atol=1e-4 * want.max())


def test_structure_tensor_predicts_the_change_under_a_shift(rng):  # T-24
    waves = rng.uniform(-0.25, 0.25, (6, 2))

    def scene(right, down):
        v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
        phase = waves[:, 0, None, None] * (u + right) + waves[:, 1, None, None] * (v + down)
        return 20 * np.sin(phase + np.arange(6)[:, None, None]).sum(axis=0)

    tensor = structure_tensor(jnp.asarray(scene(0, 0), jnp.float32), window=Box(7))
    uu, uv, vv = (float(entry[17, 22]) for entry in (tensor.uu, tensor.uv, tensor.vv))
    for right, down in ((0.1, 0.0), (0.0, 0.1), (0.1, -0.1)):
        change = np.mean((scene(right, down) - scene(0, 0))[14:21, 19:26] ** 2)
        np.testing.assert_allclose(uu * right**2 + 2 * uv * right * down + vv * down**2, change, rtol=0.1)


def test_eigenvalue_equals_numpy(rng):  # T-26
    image = jnp.asarray(textured(rng))
    for window in (Box(5), GaussianWindow(1.5)):
        tensor = structure_tensor(image, window=window)
        matrices = np.stack([tensor.uu, tensor.uv, tensor.uv, tensor.vv], axis=-1).reshape(*SHAPE, 2, 2)
        want = np.linalg.eigvalsh(matrices.astype(float))[..., 0]
        np.testing.assert_allclose(shi_tomasi(image, window=window), want, atol=1e-3 * want.max())


def test_gaussian_window_equals_opencv(rng):
    image = textured(rng)
    product = np.asarray(gradients.sobel(jnp.asarray(image)).right) ** 2
    want = cv2.GaussianBlur(product, (11, 11), 1.5)
    got = structure_tensor(jnp.asarray(image), window=GaussianWindow(1.5)).uu
    np.testing.assert_allclose(got, want, rtol=1e-3, atol=1e-2)


def test_three_classes():  # T-25: flat |R| small, edge R < 0, corner R large
    image = np.zeros(SHAPE, np.float32)
    image[10:25, 12:30] = 100
    classes = classify(harris(jnp.asarray(image)), 1e3)
    assert (int(classes[10, 12]), int(classes[17, 12]), int(classes[17, 20])) == (1, -1, 0)


def test_flat_image_is_finite_with_gradient():
    flat = jnp.full(SHAPE, 7.0)
    for response in (harris, shi_tomasi):
        assert float(jnp.abs(response(flat)).max()) == 0.0
        assert bool(jnp.isfinite(jax.grad(lambda x: response(x).sum())(flat)).all())  # noqa: B023
    refined = refine_peaks(flat, jnp.array([[5.0, 5.0], [0.0, 3.0]]))
    assert not bool(refined.ok.any()) and refined.uv.tolist() == [[5.0, 5.0], [0.0, 3.0]]


@pytest.mark.parametrize("response", [harris, shi_tomasi])
def test_gradients_equal_finite_differences(rng, x64, response):
    image = textured(rng, np.float64)
    weights, step = rng.normal(size=SHAPE), 1e-5 * rng.normal(size=SHAPE)

    def value(image):
        return (response(jnp.asarray(image)) * weights).sum()

    slope = (jax.grad(value)(jnp.asarray(image)) * step).sum()
    np.testing.assert_allclose(slope, (value(image + step) - value(image - step)) / 2, rtol=1e-5)


def test_refined_peaks(rng, dtype):
    u, v = np.meshgrid(np.arange(45), np.arange(34))
    center = np.array([20.3, 15.8])
    du, dv = u - center[0], v - center[1]
    response = jnp.asarray(-(du**2) - 0.6 * du * dv - 0.8 * dv**2, dtype)
    got = refine_peaks(response, jnp.asarray([[20, 16], [21, 16], [0, 0], [np.nan, 3]], dtype))
    np.testing.assert_allclose(got.uv[:2], [center, center], atol=1e-3)
    assert got.ok.tolist() == [True, True, False, False]
    # A saddle has no maximum.
    assert not bool(refine_peaks(jnp.asarray(du * dv, dtype), jnp.asarray([[20, 16]], dtype)).ok[0])


def test_even_windows_are_refused():
    with pytest.raises(ValueError, match="odd"):
        Box(4)


def test_vmap_equals_loop(rng):
    stack = jnp.asarray(np.stack([textured(rng), textured(rng)]))
    np.testing.assert_allclose(jax.vmap(harris)(stack)[1], harris(stack[1]), rtol=1e-4, atol=1.0)
