"""Fundamental matrices in closed form, against OpenCV, the truth, and sets that determine none."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxloc.multiview.epipolar import sampson_distance
from jaxloc.multiview.fundamental_matrix import eight_point, seven_point

K = np.array([[500.0, 0.0, 320.0], [0.0, 480.0, 240.0], [0.0, 0.0, 1.0]])
BATCH = 40


def views(rng, n, planar=False, turn_only=False):
    """Pixels of two images and the true matrix, of unit norm, ``x1^T F x2 = 0``."""
    R = Rotation.from_rotvec(rng.uniform(-0.2, 0.2, 3)).as_matrix()
    t = np.zeros(3) if turn_only else rng.normal(size=3)
    points = np.column_stack([rng.uniform(-2, 2, (n, 2)), rng.uniform(4, 12, n)])
    if planar:
        points[:, 2] = 6.0 + 0.3 * points[:, 0]
    seen = [p @ K.T for p in (points, (points - t) @ R)]
    first, second = (p[:, :2] / p[:, 2:] for p in seen)
    cross = np.cross(np.eye(3), t) @ R  # rows: e_i x t = -[t] e_i, so this is -[t]^T R = [t] R
    F = np.linalg.inv(K).T @ cross @ np.linalg.inv(K)
    return first, second, F / max(np.linalg.norm(F), 1e-12)


def test_eight_point_equals_truth_without_noise(x64, rng):
    for n in (8, 30):
        first, second, F = views(rng, n)
        found = eight_point(jnp.asarray(first), jnp.asarray(second))
        assert bool(found.ok) and float(found.separation) > 1e3
        np.testing.assert_allclose(np.abs(np.sum(found.matrix * F)), 1.0, atol=1e-12)
        assert np.abs(sampson_distance(found.matrix, jnp.asarray(first), jnp.asarray(second))).max() < 1e-8


def test_eight_point_is_as_good_as_opencvs(x64, rng):
    """Both normalize, both minimize the algebraic error; they differ in how distances are averaged."""
    ours, theirs = [], []
    for _ in range(10):
        first, second, F = views(rng, 30)
        noisy = [p + 0.5 * rng.normal(size=p.shape) for p in (first, second)]
        matrix, _ = cv2.findFundamentalMat(noisy[1], noisy[0], cv2.FM_8POINT)
        found = eight_point(*(jnp.asarray(p) for p in noisy))
        assert bool(found.ok)
        assert abs(np.linalg.det(found.matrix)) < 1e-14  # rank two
        clean = [jnp.asarray(p) for p in (first, second)]
        ours.append(np.abs(sampson_distance(found.matrix, *clean)).mean())
        theirs.append(np.abs(sampson_distance(jnp.asarray(matrix), *clean)).mean())
    np.testing.assert_allclose(np.median(ours), np.median(theirs), rtol=0.1)


def test_weights_and_masks(x64, rng):
    first, second, F = views(rng, 30)
    second[20:] += 50.0
    weights = jnp.where(jnp.arange(30) < 20, 2.0, 0.0)
    weighed = eight_point(jnp.asarray(first), jnp.asarray(second), weights=weights)
    masked = eight_point(jnp.asarray(first), jnp.asarray(np.where(np.arange(30)[:, None] < 20, second, np.nan)))
    for found in (weighed, masked):
        np.testing.assert_allclose(np.abs(np.sum(found.matrix * F)), 1.0, atol=1e-12)


def test_eight_point_derivative(x64, rng):
    first, second, _ = views(rng, 30)
    second = second + 0.5 * rng.normal(size=second.shape)
    change = rng.normal(size=second.shape)

    def matrix(t):
        found = eight_point(jnp.asarray(first), jnp.asarray(second) + t * jnp.asarray(change)).matrix
        return found * jnp.sign(found[2, 2])

    slope = jax.jvp(matrix, (0.0,), (1.0,))[1]
    difference = (matrix(1e-5) - matrix(-1e-5)) / 2e-5
    np.testing.assert_allclose(slope, difference, rtol=1e-4, atol=1e-9 * np.abs(difference).max() + 1e-12)


@pytest.mark.parametrize("kind", ["planar", "turn", "repeated", "collinear", "nan", "empty"])
def test_undetermined_sets(dtype, rng, kind):
    first, second, _ = views(rng, 30, planar=kind == "planar", turn_only=kind == "turn")
    valid = np.full(30, kind != "empty")
    if kind == "repeated":
        first[:], second[:] = first[:1], second[:1]
    if kind == "collinear":
        first[:, 1], second[:, 1] = 0.3 * first[:, 0], 0.3 * second[:, 0]
    if kind == "nan":
        first[5:] = np.nan

    def total(a, b):
        found = eight_point(a, b, valid=jnp.asarray(valid))
        return jnp.sum(found.matrix), found

    slopes, found = jax.grad(total, argnums=(0, 1), has_aux=True)(jnp.asarray(first, dtype), jnp.asarray(second, dtype))
    assert not bool(found.ok) and np.isfinite(found.matrix).all() and np.isfinite(found.separation)
    assert all(np.all(slope == 0) for slope in slopes)


def test_too_few_pairs_raise_an_error():
    with pytest.raises(ValueError, match="needs 8"):
        eight_point(jnp.zeros((7, 2)), jnp.zeros((7, 2)))


def test_seven_point_equals_opencv(x64, rng):
    """The same number of solutions, and the same ones; the true matrix among them."""
    sets = [views(rng, 7) for _ in range(BATCH)]
    first, second = (jnp.asarray(np.stack(p)) for p in zip(*[(a, b) for a, b, _ in sets], strict=True))
    found = jax.vmap(seven_point)(first, second)
    for i, (a, b, F) in enumerate(sets):
        ours = np.asarray(found.matrices[i])[np.asarray(found.valid[i])]
        assert np.abs(np.sum(ours * F, axis=(1, 2))).max() > 1 - 1e-9
        stacked, _ = cv2.findFundamentalMat(b, a, cv2.FM_7POINT)
        theirs = stacked.reshape(-1, 3, 3)
        theirs = theirs / np.linalg.norm(theirs, axis=(1, 2), keepdims=True)
        assert len(ours) == len(theirs)
        alike = np.abs(np.sum(ours[:, None] * theirs[None], axis=(2, 3)))
        assert alike.max(axis=1).min() > 1 - 1e-6


def test_seven_point_derivative(x64, rng):
    first, second, F = views(rng, 7)
    change = rng.normal(size=second.shape)

    def matrix(t):
        found = seven_point(jnp.asarray(first), jnp.asarray(second) + t * jnp.asarray(change))
        best = jnp.argmax(jnp.abs(jnp.sum(found.matrices * F[None], axis=(1, 2))))
        return found.matrices[best] * jnp.sign(found.matrices[best, 2, 2])

    slope = jax.jvp(matrix, (0.0,), (1.0,))[1]
    difference = (matrix(1e-5) - matrix(-1e-5)) / 2e-5
    np.testing.assert_allclose(slope, difference, rtol=1e-4, atol=1e-8 * np.abs(difference).max() + 1e-12)


@pytest.mark.parametrize("fill", [0.0, np.nan, 1e30])
def test_bad_sevens_stay_finite(fill):
    points = jnp.full((7, 2), fill, jnp.float32)
    value, slope = jax.value_and_grad(lambda p: jnp.sum(seven_point(p, points).matrices))(points)
    assert np.isfinite(value) and np.all(slope == 0) and not seven_point(points, points).valid.any()
