"""Detectors: what OpenCV finds, evenly spread and padded."""

import cv2
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.features.keypoints import Keypoints
from jaxloc.features.opencv import AKAZE, FAST, KAZE, ORB, SIFT, Harris, ShiTomasi, backend, detect
from jaxloc.features.select import coverage

KINDS = [ORB(), SIFT(), FAST(), Harris(), ShiTomasi(), KAZE(), AKAZE()]
IDS = [type(kind).__name__ for kind in KINDS]


def scene(rng, shape=(180, 240)):
    """Squares of random gray on noise, many on the left, few on the right."""
    image = cv2.GaussianBlur(rng.uniform(90, 110, shape), (0, 0), 1.5)
    for _ in range(150):
        u, v = int(rng.uniform(0, 1) ** 2 * 225), int(rng.uniform(5, 160))
        image[v : v + 12, u : u + 12] = rng.uniform(0, 255)
    return cv2.GaussianBlur(image, (0, 0), 1.0).astype(np.uint8)


def found(keypoints: Keypoints) -> np.ndarray:
    return np.asarray(keypoints.uv)[np.asarray(keypoints.valid)]


@pytest.mark.parametrize("kind", KINDS, ids=IDS)
def test_slots_are_padded_safe_and_on_the_image(rng, kind):
    image = scene(rng)
    for capacity in (50, 3000):
        keypoints = detect(kind, image, capacity, (3, 4))
        valid = np.asarray(keypoints.valid)
        assert keypoints.uv.shape == (capacity, 2) and keypoints.uv.dtype == jnp.float32
        assert valid.sum() == capacity if capacity == 50 else 50 < valid.sum() < capacity
        # The used slots come first; the others are zero.
        assert valid[: valid.sum()].all()
        for field in (keypoints.uv, keypoints.size, keypoints.angle, keypoints.response, keypoints.octave):
            assert np.isfinite(field).all() and not np.asarray(field)[~valid].any()
        uv = found(keypoints)
        assert (uv >= 0).all() and (uv <= [239, 179]).all()
        assert (np.asarray(keypoints.size)[valid] > 0).all()


@pytest.mark.parametrize("kind", KINDS, ids=IDS)
def test_nothing_is_found_where_nothing_is(kind):
    for image in (np.full((90, 120), 77, np.uint8), np.zeros((1, 1), np.uint8), np.full((8, 5), 0.5, np.float32)):
        keypoints = detect(kind, image, 20)
        assert not bool(keypoints.valid.any()) and not bool(keypoints.uv.any())


@pytest.mark.parametrize("kind", KINDS, ids=IDS)
def test_mask_and_number_type(rng, kind):
    image = scene(rng)
    mask = np.zeros(image.shape, bool)
    mask[:, :100] = True
    masked = found(detect(kind, image, 100, mask=mask))
    assert len(masked) > 10 and (masked[:, 0] < 101).all()
    plain = detect(kind, image, 60)
    for same in (image.astype(np.float32), jnp.asarray(image), image.astype(np.float64) / 255):
        np.testing.assert_allclose(detect(kind, same, 60).uv, plain.uv)


def test_equal_opencv_without_a_grid(rng):
    image = scene(rng)
    want = cv2.FastFeatureDetector_create(10).detect(image)
    want = sorted(want, key=lambda keypoint: -keypoint.response)[:30]
    got = detect(FAST(), image, 30, (1, 1))
    np.testing.assert_allclose(got.response, [keypoint.response for keypoint in want])
    orb = cv2.ORB_create(200, edgeThreshold=31, fastThreshold=12).detect(image)
    strongest = max(orb, key=lambda keypoint: keypoint.response)
    got = detect(ORB(), image, 100, (1, 1))
    np.testing.assert_allclose(got.uv[0], strongest.pt)
    np.testing.assert_allclose(got.angle[0], np.deg2rad(strongest.angle), rtol=1e-5)
    assert (float(got.size[0]), int(got.octave[0])) == (strongest.size, strongest.octave)


def test_corners_equal_good_features_to_track(rng):
    image = scene(rng)
    want = cv2.goodFeaturesToTrack(image, 20, 0.01, 3, blockSize=3).reshape(-1, 2)
    got = found(detect(ShiTomasi(radius=1), image, 800, (1, 1)))
    nearest = np.abs(want[:, None] - got[None]).max(axis=2).min(axis=1)
    assert (nearest <= 0.5).all()


def test_corners_are_found_between_pixels():
    u, v = np.meshgrid(np.arange(40.0), np.arange(30.0))
    blob = 200 * np.exp(-((u - 20.3) ** 2 + (v - 14.7) ** 2) / 8)
    got = detect(ShiTomasi(block_size=5), blob, 1, (1, 1))
    np.testing.assert_allclose(got.uv[0], [20.3, 14.7], atol=0.12)


@pytest.mark.parametrize("kind", KINDS, ids=IDS)
def test_the_grid_evens_out_and_backfills(rng, kind):  # T-70
    image, figures = scene(rng), []
    for grid in ((1, 1), (6, 8)):
        keypoints = detect(kind, image, 60, grid)
        assert int(keypoints.valid.sum()) == 60
        figures.append(coverage(keypoints.uv, keypoints.valid, shape=image.shape, grid=(6, 8)))
    assert float(figures[1].entropy) > float(figures[0].entropy)
    assert float(figures[1].filled) >= float(figures[0].filled)


def test_a_missing_detector_is_one_clear_error(rng, monkeypatch):
    monkeypatch.delattr(cv2, "KAZE_create")
    with pytest.raises(ImportError, match="KAZE is missing from this OpenCV.*opencv-contrib-python-headless"):
        detect(KAZE(), scene(rng), 10)

    class Contrib:
        KAZE_create = cv2.ORB_create

    # OpenCV 5 keeps it in the contrib module.
    monkeypatch.setattr(cv2, "xfeatures2d", Contrib, raising=False)
    assert backend.create("KAZE").descriptorSize() == 32


def test_wrong_options_are_refused(rng):
    image = scene(rng)
    with pytest.raises(ValueError, match="positive"):
        detect(ORB(), image, 0)
    with pytest.raises(ValueError, match="positive"):
        detect(ORB(), image, 10, (0, 3))
    with pytest.raises(ValueError, match="mask"):
        detect(ORB(), image, 10, mask=np.ones((3, 3), bool))


def test_to_uint8_of_non_finite_values():
    got = backend.to_uint8(np.array([[np.nan, np.inf, -np.inf, 300.0, -4.0, 7.5]]))
    assert got.tolist() == [[0, 255, 0, 255, 0, 8]]


@pytest.mark.recordings
def test_on_a_street(recordings):
    path = next((recordings / "kitti_odometry" / "sequences").glob("*/image_0/*.png"))
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    for kind, least in ((FAST(), 0.8), (ShiTomasi(), 0.8), (ORB(), 0.6)):
        keypoints = detect(kind, image, 1500, (6, 8))
        covered = coverage(keypoints.uv, keypoints.valid, shape=image.shape, grid=(6, 8))
        assert int(keypoints.valid.sum()) == 1500 and float(covered.filled) >= least
