"""ORB: what survives turning and scaling, beside OpenCV's corners."""

from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.features.match import match
from jaxloc.features.orb import Orb, orb

OPTIONS = Orb(levels=4)
find = jax.jit(lambda image: orb(image, options=OPTIONS, capacity=400))


@pytest.fixture(scope="module")
def photo():
    folder = Path(pytest.importorskip("skimage.data").__file__).parent
    return cv2.imread(str(folder / "astronaut.png"), cv2.IMREAD_GRAYSCALE)[:240, 100:340]


@pytest.fixture(scope="module")
def found(photo):
    return find(jnp.asarray(photo, jnp.float32))


def test_one_level_equals_opencv(photo):
    """The same corners at whole pixels, with the same directions."""
    theirs = cv2.ORB_create(100, nlevels=1, edgeThreshold=16, fastThreshold=20).detect(photo)
    ours, _ = orb(jnp.asarray(photo, jnp.float32), options=Orb(levels=1), capacity=100)
    places = {tuple(np.rint(k.pt).astype(int).tolist()): k.angle for k in theirs}
    turned = []
    for uv, angle, ok in zip(ours.uv.tolist(), np.rad2deg(ours.angle), ours.valid.tolist(), strict=True):
        if ok and tuple(round(x) for x in uv) in places:
            turned.append((angle - places[tuple(round(x) for x in uv)] + 180) % 360 - 180)
    assert len(turned) > 0.8 * len(theirs) and np.abs(turned).max() < 0.4


@pytest.mark.parametrize(("degrees", "scale"), [(40, 1.0), (0, 0.7)])
def test_matches_survive_turning_and_scaling(photo, found, degrees, scale):
    matrix = cv2.getRotationMatrix2D((119.5, 119.5), degrees, scale)
    image = cv2.warpAffine(photo, matrix, (240, 240), flags=cv2.INTER_LINEAR)
    other = find(jnp.asarray(image, jnp.float32))
    pairs = match(found[1], other[1], ratio=0.8)
    valid = np.asarray(pairs.valid)
    true = np.asarray(found[0].uv) @ matrix[:, :2].T + matrix[:, 2]
    error = np.linalg.norm(true - np.asarray(other[0].uv)[np.asarray(pairs.index)], axis=1)[valid]
    assert valid.sum() > 40 and np.mean(error < 3.0) > 0.9


def test_records_are_padded_and_bits_packed(found):
    keypoints, descriptors = found
    valid = np.asarray(keypoints.valid)
    assert descriptors.values.shape == (400, 32) and descriptors.values.dtype == jnp.uint8
    assert (valid == descriptors.valid).all() and 200 < valid.sum()
    assert set(np.asarray(keypoints.octave)[valid]) == {0, 1, 2, 3}
    np.testing.assert_allclose(np.asarray(keypoints.size)[valid], 31 * 1.2 ** np.asarray(keypoints.octave)[valid])
    for field in (keypoints.uv, keypoints.size, keypoints.angle, keypoints.response):
        assert np.isfinite(field).all() and not np.asarray(field)[~valid].any()


@pytest.mark.parametrize("value", [0.0, 120.0, np.nan])
def test_blank_images(value):
    keypoints, descriptors = find(jnp.full((240, 240), value, jnp.float32))
    assert not keypoints.valid.any() and not descriptors.values.any() and np.isfinite(keypoints.uv).all()


def test_batch_is_a_loop(photo):
    images = jnp.asarray(np.stack([photo[:100, :100], photo[100:200, 100:200]]), jnp.float32)
    run = lambda image: orb(image, options=Orb(levels=1), capacity=30)  # noqa: E731
    together = jax.jit(jax.vmap(run))(images)
    for i in range(2):
        keypoints, descriptors = run(images[i])
        assert together[0].uv[i].tolist() == keypoints.uv.tolist()
        assert (together[1].values[i] == descriptors.values).all()
