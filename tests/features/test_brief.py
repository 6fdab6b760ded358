"""Directions beside OpenCV, bits beside a plain loop, and how far both turn with the image."""

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.features import Keypoints
from jaxloc.features.brief import brief, compare, draw_tests, intensity_centroid, select_tests
from jaxloc.features.match import hamming_distances


@pytest.fixture(scope="module")
def photo():
    rng = np.random.default_rng(0)
    image = cv2.GaussianBlur(rng.uniform(0, 255, (201, 201)), (0, 0), 4.0)
    return np.clip((image - image.mean()) * (50 / image.std()) + 128, 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def points():
    rng = np.random.default_rng(1)
    return rng.integers(60, 141, (60, 2)).astype(np.float32)


def with_angle(uv, angle):
    return eqx.tree_at(lambda k: k.angle, Keypoints.from_uv(jnp.asarray(uv)), jnp.asarray(angle, jnp.float32))


def test_directions_equal_opencv(photo):  # T-52
    theirs = cv2.ORB_create(300, nlevels=1, edgeThreshold=31, fastThreshold=2).detect(photo)
    uv = np.array([k.pt for k in theirs], np.float32)
    ours = intensity_centroid(jnp.asarray(photo, jnp.float32), jnp.asarray(uv))
    apart = (np.rad2deg(ours) - [k.angle for k in theirs] + 180) % 360 - 180
    # OpenCV's arctangent is good to a third of a degree.
    assert len(theirs) > 50 and np.abs(apart).max() < 0.4


def test_directions_turn_with_the_image(photo, points, dtype):
    turned = np.ascontiguousarray(np.rot90(photo, -1))
    moved = np.stack([200 - points[:, 1], points[:, 0]], axis=1)
    plain = intensity_centroid(jnp.asarray(photo, dtype), jnp.asarray(points, dtype))
    other = intensity_centroid(jnp.asarray(turned, dtype), jnp.asarray(moved, dtype))
    assert plain.dtype == dtype
    np.testing.assert_allclose((np.asarray(other - plain) - np.pi / 2 + np.pi) % (2 * np.pi) - np.pi, 0.0, atol=1e-5)


def test_direction_has_a_derivative(x64, photo, points):
    image, change = (
        jnp.asarray(photo, jnp.float64),
        jnp.asarray(np.random.default_rng(2).normal(size=photo.shape)),
    )
    run = jax.jit(lambda t: intensity_centroid(image + t * change, jnp.asarray(points, jnp.float64)))
    np.testing.assert_allclose(jax.jvp(run, (0.0,), (1.0,))[1], (run(1e-5) - run(-1e-5)) / 2e-5, atol=1e-8)
    flat = jnp.ones((40, 40))
    assert np.isfinite(jax.grad(lambda x: intensity_centroid(x, jnp.full((1, 2), 20.0)).sum())(flat)).all()


def test_tests_are_calonders():
    tests = np.asarray(draw_tests(jax.random.key(3), count=4000))
    assert tests.shape == (4000, 4) and np.abs(tests).max() <= 13
    # A fifth of the side, cut off where the patch ends.
    assert abs(tests.mean()) < 0.15 and abs(tests.std() - 31 / 5) < 0.35
    assert (draw_tests(jax.random.key(3), count=4000) == tests).all()


def test_bits_equal_a_loop(photo, points):  # T-53
    mean, tests = cv2.blur(photo.astype(np.float64), (5, 5)), np.asarray(draw_tests(jax.random.key(0)))
    angle = np.random.default_rng(4).uniform(0, 2 * np.pi, len(points))
    ours = brief(jnp.asarray(photo, jnp.float32), with_angle(points, angle), jnp.asarray(tests))
    different = 0
    for k, ((u, v), a) in enumerate(zip(points, angle, strict=True)):
        turn = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
        first, second = (np.rint([u, v] + tests[:, side] @ turn.T).astype(int) for side in (slice(0, 2), slice(2, 4)))
        bits = mean[first[:, 1], first[:, 0]] < mean[second[:, 1], second[:, 0]]
        different += int(np.unpackbits(np.asarray(ours.values[k]) ^ np.packbits(bits, bitorder="little")).sum())
    # Means of float32 and of float64 may order equal ones differently.
    assert ours.values.shape == (60, 32) and ours.valid.all() and different <= 0.001 * 60 * 256


@pytest.mark.parametrize("degrees", [15, 45, 90, 163])
def test_hamming_distance_survives_turning(photo, points, degrees):  # T-53
    matrix = cv2.getRotationMatrix2D((100.0, 100.0), degrees, 1.0)
    turned = cv2.warpAffine(photo, matrix, (201, 201), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    tests, words = draw_tests(jax.random.key(0)), []
    for image, uv in ((photo, points), (turned, (points @ matrix[:, :2].T + matrix[:, 2]).astype(np.float32))):
        image, uv = jnp.asarray(image, jnp.float32), jnp.asarray(uv)
        words.append(brief(image, with_angle(uv, intensity_centroid(image, uv)), tests).values)
    distances = np.asarray(hamming_distances(*words))
    own, others = np.diag(distances), distances[~np.eye(60, dtype=bool)]
    assert np.median(own) < 30 and np.median(others) > 90
    # Without turning, nothing is left of it.
    upright = brief(jnp.asarray(turned, jnp.float32), Keypoints.from_uv(uv), tests).values
    assert np.median(np.diag(hamming_distances(words[0], upright))) > 2 * np.median(own)


def test_selected_tests_are_less_alike_and_even(photo):  # T-53: rBRIEF
    rng = np.random.default_rng(5)
    uv = rng.uniform(25, 175, (500, 2)).astype(np.float32)
    image, many = jnp.asarray(photo, jnp.float32), draw_tests(jax.random.key(6), count=600)
    bits = np.asarray(compare(image, with_angle(uv, intensity_centroid(image, jnp.asarray(uv))), many))
    chosen = np.asarray(select_tests(jnp.asarray(bits), count=64))
    assert len(set(chosen.tolist())) == 64

    def likeness(index):
        return np.abs(np.corrcoef(bits[:, index].T.astype(float)) - np.eye(len(index)))

    # No pair of them is as much alike as the worst of those that were drawn.
    limit = likeness(chosen).max() * (1 + 1e-6)
    assert limit < np.percentile(likeness(np.arange(64)), 99)
    assert likeness(chosen).mean() < 0.9 * likeness(np.arange(64)).mean()


def test_wrong_numbers_of_tests(photo):
    with pytest.raises(ValueError, match="multiple of eight"):
        brief(jnp.zeros((40, 40)), Keypoints.from_uv(jnp.ones((1, 2))), jnp.zeros((9, 4), jnp.int32))
    with pytest.raises(ValueError, match="candidates"):
        select_tests(jnp.zeros((5, 3), bool), count=4)


def test_the_border_and_blank_images():
    tests = draw_tests(jax.random.key(0))
    found = brief(
        jnp.full((60, 60), jnp.nan), with_angle(np.array([[1.0, 30], [30, 30]], np.float32), [0.0, 0.0]), tests
    )
    assert found.valid.tolist() == [False, True] and not found.values.any()
    assert not intensity_centroid(jnp.full((60, 60), jnp.nan), jnp.array([[30.0, 30], [jnp.nan, 2]])).any()
    # Candidates that never differ fill up only when nothing else is left.
    assert select_tests(jnp.zeros((5, 4), bool), count=3).tolist() == [0, 1, 2]
