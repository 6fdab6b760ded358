"""Descriptors against OpenCV's own, and their order."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.features.keypoints import Keypoints
from jaxloc.features.opencv import AKAZE, FAST, KAZE, ORB, SIFT, ShiTomasi, describe, detect

KINDS = [ORB(), SIFT(), KAZE(), AKAZE()]
IDS = [type(kind).__name__ for kind in KINDS]
SIZES = {"ORB": 32, "SIFT": 128, "KAZE": 64, "AKAZE": 61}


def scene(rng):
    return cv2.GaussianBlur(rng.uniform(0, 255, (160, 220)), (0, 0), 2.0).astype(np.float32)


@pytest.mark.parametrize("kind", KINDS, ids=IDS)
def test_equal_opencv(rng, kind):
    image = cv2.normalize(scene(rng), None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    extractor = kind.extractor(400)
    points, want = extractor.compute(image, extractor.detect(image))
    got_points = detect(kind, image, 200, (1, 1))
    got = describe(kind, image, got_points)
    assert got.values.dtype == want.dtype and got.values.shape == (200, SIZES[type(kind).__name__])
    assert bool(got.valid[got_points.valid].all())
    # KAZE only measures the angle when it describes.
    turned = type(kind).__name__ not in ("KAZE", "AKAZE")
    key = {(p.pt, turned * round(p.angle, 2), p.octave): row for p, row in zip(points, want, strict=True)}
    hits = 0
    for i in np.flatnonzero(np.asarray(got.valid)):
        angle = turned * round(float(np.rad2deg(got_points.angle[i])), 2)
        row = key.get((tuple(got_points.uv[i].tolist()), angle, int(got_points.octave[i])))
        if row is not None:
            hits += 1
            different = np.unpackbits(row ^ got.values[i]).mean() if row.dtype == np.uint8 else None
            if different is None:
                assert np.dot(got.values[i], row) > 0.97 * np.linalg.norm(got.values[i]) * np.linalg.norm(row)
            else:
                assert different < 0.03
    assert hits > 50


@pytest.mark.parametrize("kind", KINDS, ids=IDS)
def test_order_and_mask_are_kept(rng, kind):
    image = scene(rng)
    keypoints = detect(kind, image, 80)
    straight = describe(kind, image, keypoints)
    order = jnp.asarray(rng.permutation(80))
    shuffled = jax.tree.map(lambda x: x[order], keypoints)
    hidden = rng.uniform(size=80) < 0.3
    shuffled = Keypoints(**{**vars(shuffled), "valid": shuffled.valid & ~jnp.asarray(hidden)})
    got = describe(kind, image, shuffled)
    want_valid = np.asarray(straight.valid)[order] & ~hidden
    np.testing.assert_array_equal(got.valid, want_valid)
    np.testing.assert_array_equal(got.values, np.where(want_valid[:, None], np.asarray(straight.values)[order], 0))


@pytest.mark.parametrize("kind", KINDS, ids=IDS)
def test_any_keypoints_can_be_described(rng, kind):
    image = scene(rng)
    for keypoints in (detect(FAST(), image, 60), detect(ShiTomasi(), image, 60), detect(SIFT(), image, 60)):
        got = describe(kind, image, keypoints)
        assert int(got.valid.sum()) > 20
    anywhere = Keypoints.from_uv(jnp.asarray(rng.uniform(-5, 230, (300, 2)), jnp.float32))
    got = describe(kind, image, anywhere)
    off = (np.asarray(anywhere.uv) < 0).any(axis=1) | (np.asarray(anywhere.uv) > [219, 159]).any(axis=1)
    assert not np.asarray(got.valid)[off].any() and int(got.valid.sum()) > 50
    assert np.isfinite(np.asarray(got.values, float)).all()


def test_orb_keeps_the_slot_of_what_the_border_drops(rng):
    image = scene(rng)
    uv = jnp.array([[3.0, 3.0], [100.0, 80.0], [218.0, 80.0], [60.0, 60.0]])
    got = describe(ORB(), image, Keypoints.from_uv(uv))
    assert got.valid.tolist() == [False, True, False, True]
    alone = describe(ORB(), image, Keypoints.from_uv(uv[3:]))
    np.testing.assert_array_equal(got.values[3], alone.values[0])


@pytest.mark.parametrize("kind", KINDS, ids=IDS)
def test_empty_sets_and_tiny_images(rng, kind):
    empty = Keypoints.from_uv(jnp.zeros((5, 2)), jnp.zeros(5, dtype=bool))
    for image in (scene(rng), np.zeros((2, 2), np.uint8)):
        got = describe(kind, image, empty)
        assert got.values.shape == (5, SIZES[type(kind).__name__]) and not bool(got.valid.any())
    tiny = describe(kind, np.zeros((2, 2), np.uint8), Keypoints.from_uv(jnp.zeros((1, 2))))
    assert not bool(tiny.valid[0])
