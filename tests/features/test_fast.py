"""FAST beside OpenCV, corner by corner, and beside a plain loop."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.features.fast import CIRCLE, fast, segment_score, strongest_keypoints, suppress_non_maxima


@pytest.fixture(scope="module")
def photo():
    rng = np.random.default_rng(0)
    image = cv2.GaussianBlur(rng.uniform(60, 140, (90, 120)), (0, 0), 1.0)
    for _ in range(60):
        u, v = rng.integers(5, 110), rng.integers(5, 80)
        image[v : v + 9, u : u + 9] = rng.uniform(0, 255)
    return image.astype(np.uint8)


def corners(found):
    uv, score = np.asarray(found.uv)[np.asarray(found.valid)], np.asarray(found.response)[np.asarray(found.valid)]
    return {(int(u), int(v), int(s)) for (u, v), s in zip(uv, score, strict=True)}


@pytest.mark.parametrize("threshold", [5, 20, 60])
def test_corners_and_scores_equal_opencv(photo, dtype, threshold):  # T-51
    peer = cv2.FastFeatureDetector_create(threshold, True)
    theirs = {(int(k.pt[0]), int(k.pt[1]), int(k.response) + 1) for k in peer.detect(photo)}
    found = fast(jnp.asarray(photo, dtype), threshold=threshold, capacity=2000)
    assert found.uv.dtype == dtype and len(theirs) > 20
    assert corners(found) == theirs


def test_without_thinning_equal_opencv(photo):
    peer = cv2.FastFeatureDetector_create(20, False)
    theirs = {(int(k.pt[0]), int(k.pt[1])) for k in peer.detect(photo)}
    rows, columns = np.nonzero(np.asarray(segment_score(jnp.asarray(photo, jnp.float32))) > 20)
    assert set(zip(columns.tolist(), rows.tolist(), strict=True)) == theirs


@pytest.mark.parametrize("arc", [9, 10, 12, 16])
def test_score_equals_a_loop(photo, arc):  # T-51: FAST-9 to FAST-12
    image = photo[:24, :30].astype(float)
    ours = segment_score(jnp.asarray(image, jnp.float32), arc=arc)
    plain = np.zeros(image.shape)
    for v in range(3, 21):
        for u in range(3, 27):
            ring = [image[v + down, u + right] - image[v, u] for right, down in CIRCLE]
            arcs = [[ring[(k + j) % 16] for j in range(arc)] for k in range(16)]
            plain[v, u] = max(0.0, *(min(a) for a in arcs), *(-max(a) for a in arcs))
    np.testing.assert_allclose(ours, plain)


def test_longer_arcs_find_fewer_corners(photo):
    counts = [int((segment_score(jnp.asarray(photo, jnp.float32), arc=arc) > 10).sum()) for arc in (9, 10, 12)]
    assert counts == sorted(counts, reverse=True) and counts[0] > 1.2 * counts[2] > 0


def test_strongest_come_first_and_slots_are_safe(photo):
    image = jnp.asarray(photo, jnp.float32)
    few, many = fast(image, threshold=20.0, capacity=10), fast(image, threshold=20.0, capacity=2000)
    assert corners(few) <= corners(many) and float(few.response.min()) >= float(many.response[10])
    assert not np.asarray(many.uv)[~np.asarray(many.valid)].any() and not many.angle.any()
    assert strongest_keypoints(jnp.zeros((4, 5)), 30).valid.shape == (30,)


def test_score_does_not_depend_on_bias_and_turns(photo):
    image = photo[:90, :90].astype(np.float32)
    score = segment_score(jnp.asarray(image))
    np.testing.assert_allclose(segment_score(jnp.asarray(image + 40)), score)
    np.testing.assert_allclose(segment_score(jnp.asarray(np.rot90(image).copy())), np.rot90(score))


def test_gradients_equal_differences(x64, rng):
    image, change = jnp.asarray(rng.uniform(0, 255, (14, 15))), jnp.asarray(rng.normal(size=(14, 15)))
    run = jax.jit(lambda t: segment_score(image + t * change))
    np.testing.assert_allclose(jax.jvp(run, (0.0,), (1.0,))[1], (run(1e-6) - run(-1e-6)) / 2e-6, atol=1e-6)


@pytest.mark.parametrize("image", [np.zeros((20, 20)), np.full((20, 20), np.nan), np.ones((5, 9)), np.ones((1, 1))])
def test_nothing_is_found_where_nothing_is(image):
    found = fast(jnp.asarray(image, jnp.float32), capacity=4)
    assert (
        not found.valid.any()
        and np.isfinite(found.uv).all()
        and not suppress_non_maxima(segment_score(jnp.ones((9, 9)))).any()
    )


def test_wrong_arcs_are_refused():
    with pytest.raises(ValueError, match="arc of 17"):
        segment_score(jnp.zeros((20, 20)), arc=17)


def test_batch_is_a_loop(photo):
    images = jnp.asarray(np.stack([photo[:40, :40], photo[40:80, 40:80]]), jnp.float32)
    together = jax.vmap(lambda x: fast(x, capacity=20))(images)
    for i in range(2):
        assert together.uv[i].tolist() == fast(images[i], capacity=20).uv.tolist()
