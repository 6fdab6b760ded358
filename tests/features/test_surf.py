"""SURF against plain NumPy, and its invariance to rotation, scale and illumination."""

from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

from jaxloc.features import Keypoints
from jaxloc.features.match import match
from jaxloc.features.surf import Surf, describe_surf, laplacian_gate, surf

ONE = Surf(octaves=1)
find = jax.jit(lambda image: surf(image, capacity=400))


@pytest.fixture(scope="module")
def photo():
    folder = Path(pytest.importorskip("skimage.data").__file__).parent
    return cv2.imread(str(folder / "astronaut.png"), cv2.IMREAD_GRAYSCALE)[:257, 100:357]


@pytest.fixture(scope="module")
def found(photo):
    return find(jnp.asarray(photo, jnp.float32))


def warped(photo, degrees, scale):
    matrix = cv2.getRotationMatrix2D((128.0, 128.0), degrees, scale)
    return cv2.warpAffine(photo, matrix, (257, 257), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT), matrix


def kept(found):
    keypoints, descriptors = found
    valid = np.asarray(keypoints.valid)
    fields = keypoints.uv, keypoints.size, keypoints.angle, keypoints.layer, descriptors.values
    return tuple(np.asarray(x)[valid] for x in fields)


def haar(image, u, v, half):
    """Right less left, lower less upper half of a square about a corner of pixels."""
    square = image[v - half : v + half, u - half : u + half]
    return (
        (square[:, half:].sum() - square[:, :half].sum()) / (2 * half**2),
        (square[half:].sum() - square[:half].sum()) / (2 * half**2),
    )


def test_descriptor_equals_a_plain_sum(photo):  # T-39
    """Upright at scale two, with all samples at corners of pixels."""
    image, center, values = photo.astype(float), 119.5, []
    points = Keypoints.from_uv(jnp.array([[center, center]]), size=15.0)
    ours = describe_surf(jnp.asarray(photo, jnp.float32), points)
    for row in range(4):
        for column in range(4):
            total = np.zeros(4)
            for i in range(5 * row, 5 * row + 5):
                for j in range(5 * column, 5 * column + 5):
                    across, down = 2 * (j - 9.5), 2 * (i - 9.5)
                    du, dv = haar(image, int(center + across + 0.5), int(center + down + 0.5), 2)
                    weight = np.exp(-((across / 2) ** 2 + (down / 2) ** 2) / (2 * 3.3**2))
                    total += weight * np.array([du, dv, abs(du), abs(dv)])
            values.extend(total)
    np.testing.assert_allclose(ours.values[0], np.array(values) / np.linalg.norm(values), atol=1e-5)
    assert ours.values.shape == (1, 64)


def test_blobs_have_their_size_and_sign(x64):
    """A Gaussian blob is extreme where its blur is a sixth of the filter; dark ones have a positive Laplacian."""
    v, u = np.mgrid[:128, :128]
    for sigma, sign in ((2.4, -1), (3.5, 1)):
        image = 128 - sign * 100 * np.exp(-((u - 60.3) ** 2 + (v - 66.6) ** 2) / (2 * sigma**2))
        uv, size, _, signs, _ = kept(surf(jnp.asarray(image), options=ONE, capacity=4))
        np.testing.assert_allclose(uv[0], [60.3, 66.6], atol=0.1)
        assert size[0] / 6 == pytest.approx(sigma, rel=0.12) and signs[0] == sign


def test_keypoints_turn_with_the_image(photo, found):
    """By a quarter, which nothing disturbs."""
    uv, size, angle, sign, values = kept(found)
    assert len(uv) > 200
    turned = kept(find(jnp.asarray(np.ascontiguousarray(np.rot90(photo, -1)), jnp.float32)))
    distance, index = cKDTree(turned[0]).query(np.stack([256 - uv[:, 1], uv[:, 0]], axis=1))
    apart = np.abs((turned[2][index] - angle - np.pi / 2 + np.pi) % (2 * np.pi) - np.pi)
    same = (distance < 0.05) & (apart < 0.02) & (np.sum(values * turned[4][index], axis=1) > 0.99)
    assert np.mean(same) > 0.9
    assert (sign == turned[3][index])[same].all() and np.allclose(size[same], turned[1][index][same], rtol=1e-3)


@pytest.mark.parametrize(("degrees", "scale", "least"), [(30, 1.0, 0.75), (0, 0.7, 0.75), (45, 1.4, 0.6)])
def test_matches_survive_turning_and_scaling(photo, found, degrees, scale, least):
    image, matrix = warped(photo, degrees, scale)
    other = find(jnp.asarray(image, jnp.float32))
    pairs = match(found[1], other[1], ratio=0.8)
    valid = np.asarray(pairs.valid)
    true = np.asarray(found[0].uv) @ matrix[:, :2].T + matrix[:, 2]
    error = np.linalg.norm(true - np.asarray(other[0].uv)[np.asarray(pairs.index)], axis=1)[valid]
    assert valid.sum() > 30 and np.mean(error < 3.0) > least


def test_the_sign_gate_halves_the_candidates_and_loses_no_match(photo, found):  # T-40
    image, matrix = warped(photo, 20, 0.9)
    other = find(jnp.asarray(image, jnp.float32))
    gate = laplacian_gate(found[0], other[0])
    pairs = found[0].valid[:, None] & other[0].valid[None, :]
    assert 0.4 < float((gate & pairs).sum() / pairs.sum()) < 0.6
    true = np.asarray(found[0].uv) @ matrix[:, :2].T + matrix[:, 2]

    def right(matches):
        error = np.linalg.norm(true - np.asarray(other[0].uv)[np.asarray(matches.index)], axis=1)
        return set(np.flatnonzero(np.asarray(matches.valid) & (error < 2.0)))

    plain, gated = right(match(*(x[1] for x in (found, other)))), right(match(found[1], other[1], gate=gate))
    assert len(plain) > 100 and plain <= gated


def test_descriptors_know_no_gain_and_bias(photo):
    points = Keypoints.from_uv(jnp.array([[100.0, 120.0], [130.5, 80.2], [2.0, 2.0]]), size=15.0)
    image = jnp.asarray(photo, jnp.float32)
    plain, darker = describe_surf(image, points), describe_surf(0.5 * image + 30.0, points)
    np.testing.assert_allclose(plain.values, darker.values, atol=1e-4)
    np.testing.assert_allclose(jnp.linalg.norm(plain.values, axis=1), 1.0, atol=1e-5)


def test_gradients_equal_differences(x64, photo):
    image = jnp.asarray(cv2.GaussianBlur(photo, (0, 0), 1.0)[60:124, 90:154], jnp.float64)
    change = jnp.asarray(np.random.default_rng(0).normal(size=image.shape))

    @jax.jit
    def features(t):
        keypoints, descriptors = surf(image + t * change, options=ONE, capacity=6)
        shown = keypoints.uv[:3], keypoints.size[:3], keypoints.angle[:3], descriptors.values[:3]
        return jnp.concatenate([x.reshape(-1) for x in shown])

    slope, step = jax.jit(jax.jacfwd(features))(0.0), 1e-6
    assert np.abs(slope).max() > 1e-4
    np.testing.assert_allclose(slope, (features(step) - features(-step)) / (2 * step), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("value", [0.0, 120.0, np.nan])
def test_blank_images(value):
    def total(image):
        keypoints, descriptors = surf(image, options=ONE, capacity=6)
        return jnp.sum(keypoints.uv) + jnp.sum(descriptors.values), keypoints

    slope, keypoints = jax.grad(total, has_aux=True)(jnp.full((64, 64), value, jnp.float32))
    assert not keypoints.valid.any() and not keypoints.layer.any() and np.isfinite(slope).all()


def test_batch_is_a_loop(photo):
    images = jnp.asarray(np.stack([photo[:64, :64], photo[64:128, 64:128]]), jnp.float32)
    run = jax.jit(lambda image: surf(image, options=ONE, capacity=6))
    together = jax.jit(jax.vmap(lambda image: surf(image, options=ONE, capacity=6)))(images)
    for i in range(2):
        keypoints, descriptors = run(images[i])
        np.testing.assert_allclose(together[0].uv[i], keypoints.uv, atol=1e-3)
        np.testing.assert_allclose(together[1].values[i], descriptors.values, atol=1e-4)
