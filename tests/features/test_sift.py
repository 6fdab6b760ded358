"""SIFT in JAX beside OpenCV's, and what turning, scaling and lighting do to it."""

from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

from jaxloc.features import Keypoints
from jaxloc.features.sift import describe_sift, sift

find = jax.jit(lambda image: sift(image, capacity=1500))


@pytest.fixture(scope="module")
def photo():
    folder = Path(pytest.importorskip("skimage.data").__file__).parent
    return cv2.imread(str(folder / "astronaut.png"), cv2.IMREAD_GRAYSCALE)[:384, :384]


@pytest.fixture(scope="module")
def found(photo):
    return find(jnp.asarray(photo, jnp.float32))


def kept(found):
    keypoints, descriptors = found
    valid = np.asarray(keypoints.valid)
    return *(np.asarray(x)[valid] for x in (keypoints.uv, keypoints.size, keypoints.angle)), np.asarray(
        descriptors.values
    )[valid]


def test_equal_opencv(photo, found):  # T-33...T-35
    peer = cv2.SIFT_create(0, 3, 0.04, 10, 1.6, cv2.CV_32F, True)
    theirs, words = peer.detectAndCompute(photo, None)
    uv, size, angle, values = kept(found)
    tree, angles, cosines, sizes, near = cKDTree(uv), [], [], [], 0
    for keypoint, word in zip(theirs, words, strict=True):
        close = tree.query_ball_point(keypoint.pt, 1.0)
        near += bool(close)
        if not close:
            continue
        apart = np.abs((angle[close] - np.deg2rad(keypoint.angle) + np.pi) % (2 * np.pi) - np.pi)
        twin = close[int(np.argmin(apart))]
        angles.append(apart.min())
        sizes.append(size[twin] / keypoint.size)
        cosines += [values[twin] @ word / np.linalg.norm(word)] * int(apart.min() < 0.1)
    assert near >= 0.99 * len(theirs)
    assert np.mean(np.array(angles) < 0.1) > 0.95 and np.mean(np.abs(np.array(sizes) - 1) < 0.01) > 0.98
    assert np.median(cosines) > 0.99 and values.shape[1] == 128


def test_a_blob_has_its_own_size(x64):
    """A Gaussian blob of variance t is extreme where the two blurs of a difference lie about it."""
    v, u = np.mgrid[:96, :96]
    for sigma in (3.0, 5.0):
        image = 40 + 150 * np.exp(-((u - 47.3) ** 2 + (v - 50.6) ** 2) / (2 * sigma**2))
        uv, size, _, _ = kept(sift(jnp.asarray(image), capacity=8))
        np.testing.assert_allclose(uv[0], [47.3, 50.6], atol=0.06)
        # sigma / sqrt(k) with k = 2^(1/3), and the camera's blur that the image is thought to have.
        assert 0.5 * size[0] == pytest.approx(sigma / 2 ** (1 / 6), rel=0.03)


def test_keypoints_turn_with_the_image(photo, found):
    """By a quarter, which no interpolation disturbs (but the doubled image's last row)."""
    uv, _, angle, values = kept(found)
    turned = kept(find(jnp.asarray(np.ascontiguousarray(np.rot90(photo, -1)), jnp.float32)))
    expected = np.stack([383 - uv[:, 1], uv[:, 0]], axis=1)
    distance, index = cKDTree(turned[0]).query(expected, k=3)
    best = np.argmin(np.abs((turned[2][index] - angle[:, None] - np.pi / 2 + np.pi) % (2 * np.pi) - np.pi), axis=1)
    twin = index[np.arange(len(uv)), best]
    cosine = np.sum(values * turned[3][twin], axis=1)
    assert np.mean((distance[:, 0] < 0.2) & (cosine > 0.98)) > 0.9


def test_descriptors_know_no_gain_and_bias(photo):
    points = Keypoints.from_uv(jnp.array([[100.0, 120.0], [200.5, 80.2], [2.0, 2.0]]), size=10.0)
    image = jnp.asarray(photo, jnp.float32)
    plain, darker = describe_sift(image, points), describe_sift(0.4 * image + 30.0, points)
    np.testing.assert_allclose(plain.values, darker.values, atol=1e-4)
    np.testing.assert_allclose(jnp.linalg.norm(plain.values, axis=1), 1.0, atol=1e-5)


@pytest.mark.slow
def test_gradients_equal_differences(x64, photo):
    image = jnp.asarray(cv2.GaussianBlur(photo, (0, 0), 1.0)[60:124, 190:254], jnp.float64)
    change = jnp.asarray(np.random.default_rng(0).normal(size=image.shape))

    @jax.jit
    def features(t):
        keypoints, descriptors = sift(image + t * change, capacity=8)
        slots = slice(0, 3)
        shown = keypoints.uv[slots], keypoints.size[slots], keypoints.angle[slots], descriptors.values[slots]
        return jnp.concatenate([x.reshape(-1) for x in shown])

    slope, step = jax.jit(jax.jacfwd(features))(0.0), 1e-6
    difference = (features(step) - features(-step)) / (2 * step)
    assert np.abs(slope).max() > 1e-4
    np.testing.assert_allclose(slope, difference, rtol=1e-4, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("value", [0.0, 120.0, np.nan])
def test_blank_images(value):
    def total(image):
        keypoints, descriptors = sift(image, capacity=8)
        return jnp.sum(keypoints.uv) + jnp.sum(descriptors.values), keypoints.valid

    slope, valid = jax.grad(total, has_aux=True)(jnp.full((40, 44), value, jnp.float32))
    assert not valid.any() and np.isfinite(slope).all()


@pytest.mark.slow
def test_batch_is_a_loop(photo):
    images = jnp.asarray(np.stack([photo[:96, :96], photo[96:192, 96:192]]), jnp.float32)
    run = lambda image: sift(image, capacity=20)[0].uv  # noqa: E731
    together = jax.jit(jax.vmap(run))(images)
    for i in range(2):
        np.testing.assert_allclose(together[i], run(images[i]), atol=1e-3)
