import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxloc as jl
from jaxloc.images import Homography
from jaxloc.multiview.homography import (
    direct_linear_transform,
    estimate_homography,
    four_points,
    plane_homography,
    transfer_error,
)
from jaxloc.poses import SE3, Direction

MATRIX = np.array([[0.9, 0.1, 20.0], [-0.05, 1.1, -10.0], [2e-4, -1e-4, 1.0]])
SIGMA = 0.5
CORNERS = np.array([[0.0, 0.0], [600.0, 0.0], [600.0, 600.0], [0.0, 600.0]])

estimate = jax.jit(
    lambda first, second, key, valid: estimate_homography(first, second, key=key, sigma=SIGMA, valid=valid)
)


def transfer(matrix, points):
    moved = np.column_stack([points, np.ones(len(points))]) @ matrix.T
    return moved[:, :2] / moved[:, 2:]


def pairs(seed, false=0.4, count=120):
    rng = np.random.default_rng(seed)
    first = rng.uniform(0, 600, (count, 2))
    second = transfer(MATRIX, first) + SIGMA * rng.normal(size=first.shape)
    second[: int(false * count)] = rng.uniform(0, 600, (int(false * count), 2))
    return first + SIGMA * rng.normal(size=first.shape), second


def everyone(count=120):
    return jnp.ones(count, bool)


def test_of_a_plane_is_how_its_points_move(x64, rng):
    camera = jl.sensors.Pinhole(500.0, 480.0, 320.0, 240.0, 3.0)
    T = SE3.exp(jnp.asarray(rng.uniform(-0.2, 0.2, 6)))
    normal, distance = Direction.from_vector(jnp.array([0.2, -0.1, 1.0])), jnp.array(4.0)
    points = np.column_stack([rng.uniform(-1, 1, (10, 2)), np.zeros(10)])
    n = np.asarray(normal.vector)
    points[:, 2] = (4.0 - points[:, :2] @ n[:2]) / n[2]
    first, second = camera.project(jnp.asarray(points)), camera.project(T.inverse().apply(jnp.asarray(points)))
    np.testing.assert_allclose(plane_homography(camera, camera, T, normal, distance).apply(first), second, atol=1e-9)


def test_direct_linear_transform_equals_opencv(x64, rng):
    first, second = pairs(0, false=0.0, count=12)
    second[3] = 1e4
    valid = np.arange(12) != 3
    found = direct_linear_transform(jnp.asarray(first.T), jnp.asarray(second.T), jnp.asarray(valid))
    theirs, _ = cv2.findHomography(first[valid], second[valid])
    grid = transfer(theirs, CORNERS)
    np.testing.assert_allclose(transfer(np.asarray(found), CORNERS), grid, atol=0.5)


def test_four_points_are_met_exactly(x64, rng):
    first, second = CORNERS + rng.uniform(-50, 50, (4, 2)), CORNERS + rng.uniform(-50, 50, (4, 2))
    found = four_points(jnp.asarray(first), jnp.asarray(second))
    theirs = cv2.getPerspectiveTransform(first.astype(np.float32), second.astype(np.float32))
    np.testing.assert_allclose(found.apply(jnp.asarray(first)), second, atol=1e-9)
    np.testing.assert_allclose(found.homogeneous / found.homogeneous[2, 2], theirs, rtol=1e-3, atol=1e-4)


def test_among_false_correspondences_it_is_as_near_as_magsac(x64):
    ours, theirs, truth = [], [], transfer(MATRIX, CORNERS)
    for seed in range(20):
        first, second = pairs(seed)
        fit = estimate(jnp.asarray(first), jnp.asarray(second), jax.random.key(seed), everyone())
        assert bool(fit.ok)
        ours.append(np.abs(fit.value.apply(jnp.asarray(CORNERS)) - truth).max())
        peer, _ = cv2.findHomography(first, second, cv2.USAC_MAGSAC, 2.0)
        theirs.append(np.abs(transfer(peer, CORNERS) - truth).max())
    assert np.median(ours) < 1.15 * np.median(theirs)


@pytest.mark.slow
def test_consistency(x64):
    """Without false correspondences, under least squares: eight degrees of freedom."""
    true = Homography.from_matrix(jnp.asarray(MATRIX))
    options = {"sigma": SIGMA, "hypotheses": 16, "loss": jl.solvers.Quadratic()}
    run = jax.jit(lambda a, b, key: estimate_homography(a, b, key=key, **options))

    def squared(seed):
        first, second = pairs(seed, false=0.0, count=40)
        return float(
            run(jnp.asarray(first), jnp.asarray(second), jax.random.key(seed)).gaussian().mahalanobis_squared(true)
        )

    # Its standard deviation is 4 / sqrt(200) = 0.28.
    assert 7.2 < np.mean([squared(seed) for seed in range(200)]) < 8.8


@pytest.mark.slow
def test_gradients_equal_differences(x64):
    first, second = (jnp.asarray(v) for v in pairs(1))
    corners = jnp.asarray(CORNERS)
    place = lambda b: estimate(first, b, jax.random.key(0), everyone()).value.apply(corners)[2]  # noqa: E731
    slopes = jax.jacrev(place)(second)
    for index in (60, 100):
        step = np.zeros((120, 2))
        step[index, 0] = 1e-3
        difference = (place(second + step) - place(second - step)) / 2e-3
        np.testing.assert_allclose(slopes[:, index, 0], difference, rtol=1e-4, atol=1e-7)


def test_masked_equals_absent(x64):
    first, second = pairs(2, false=0.0)
    hole = second.copy()
    hole[-20:] = np.nan
    first, second, hole = jnp.asarray(first), jnp.asarray(second), jnp.asarray(hole)
    a = estimate(first, hole, jax.random.key(0), everyone())
    b = estimate(first, second, jax.random.key(0), jnp.arange(120) < 100)
    np.testing.assert_allclose(a.value.homogeneous, b.value.homogeneous, rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["same", "line", "random", "nan", "three"])
def test_degenerate_sets_are_not_ok(dtype, kind):
    first, second = pairs(3)
    if kind == "same":
        first, second = np.full_like(first, 10.0), np.full_like(second, 20.0)
    if kind == "line":
        first[:, 1], second[:, 1] = first[:, 0], second[:, 0]
    if kind == "random":
        second = np.random.default_rng(0).uniform(0, 600, first.shape)
    if kind == "nan":
        second[:] = np.nan
    valid = jnp.arange(120) < (3 if kind == "three" else 120)
    first, second = jnp.asarray(first, dtype), jnp.asarray(second, dtype)

    def total(b):
        fit = estimate(first, b, jax.random.key(0), valid)
        return jnp.sum(fit.value.homogeneous), fit

    slope, fit = jax.grad(total, has_aux=True)(second)
    assert fit.value.homogeneous.dtype == dtype
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((fit, slope)))
    assert not bool(fit.ok)


def test_points_at_the_horizon_have_finite_derivatives():
    """Their squares overflow: they count as gross errors, which nothing moves."""
    matrix = jnp.array([[600.0, 0.0, 10.0], [0.0, 500.0, 20.0], [-1.0 / 300.0, 0.0, 1.0]])
    first = jnp.array([[300.0 - 3e-5, 299.0, 10.0], [5.0, 5.0, 5.0]])

    @jax.jit
    @jax.value_and_grad
    def cost(matrix):
        return jnp.sum(transfer_error(matrix, first, jnp.zeros((2, 3)), 1.0, jnp.ones(3, bool)) ** 2)

    value, slope = cost(matrix)
    assert np.isfinite(value) and value >= 2e6 and np.isfinite(slope).all() and np.abs(slope).max() > 0


def test_too_few_correspondences_raise():
    with pytest.raises(ValueError, match="sample of 4"):
        estimate_homography(jnp.zeros((3, 2)), jnp.zeros((3, 2)), key=jax.random.key(0))


@pytest.mark.slow
@pytest.mark.recordings
def test_graffiti(recordings):
    """A painted wall from two sides, with the homography of its authors."""
    folder = recordings / "homography_graf"
    stored = cv2.FileStorage(str(folder / "H1to3p.xml"), cv2.FILE_STORAGE_READ)
    truth = stored.getFirstTopLevelNode().mat()
    photos = [cv2.imread(str(folder / f"graf{i}.png"), cv2.IMREAD_GRAYSCALE) for i in (1, 3)]
    sift = cv2.SIFT_create(2000)
    (keys1, words1), (keys2, words2) = (sift.detectAndCompute(image, None) for image in photos)
    matches = [m for m, n in cv2.BFMatcher().knnMatch(words1, words2, k=2) if m.distance < 0.85 * n.distance]
    first = np.array([keys1[m.queryIdx].pt for m in matches])
    second = np.array([keys2[m.trainIdx].pt for m in matches])
    fit = estimate_homography(
        jnp.asarray(first), jnp.asarray(second), key=jax.random.key(0), sigma=1.0, hypotheses=1024
    )
    rows, columns = photos[0].shape
    corners = np.array([[0.2, 0.2], [0.8, 0.2], [0.8, 0.8], [0.2, 0.8]]) * [columns, rows]
    assert bool(fit.ok)
    # Some pixels: the wall is not quite flat, and the published homography was fitted to points as well.
    assert np.abs(fit.value.apply(jnp.asarray(corners)) - transfer(truth, corners)).max() < 4.0
