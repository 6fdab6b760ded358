"""Relative poses among false correspondences: OpenCV's consensus, statistics, derivatives, and sets that have none."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxloc.multiview.epipolar import RelativePose
from jaxloc.multiview.two_view import ConsensusOptions, estimate_relative_pose
from jaxloc.poses import SE3, SO3, Direction
from jaxloc.solvers import Quadratic

FOCAL, SIZE, SIGMA, COUNT = 700.0, np.array([1240.0, 376.0]), 0.5, 200
# Compiled once for each dtype: what tests share.
LIGHT = ConsensusOptions(hypotheses=64, pretest=64, finalists=8, refined=2)


@jax.jit
def estimate(first, second, valid, key):
    return estimate_relative_pose(first, second, sigma=SIGMA / FOCAL, valid=valid, key=key, consensus=LIGHT)


def pairs(seed, false=0.4, sigma=SIGMA, turn=0.15, step=1.0, planar=False):
    """Pixels about the center of two images, and ``T_first_second``."""
    rng = np.random.default_rng(seed)
    R = Rotation.from_rotvec(rng.uniform(-turn, turn, 3)).as_matrix()
    t = rng.normal(size=3)
    t *= step / np.linalg.norm(t)
    first, second = np.zeros((0, 2)), np.zeros((0, 2))
    while len(first) < COUNT:
        u = rng.uniform(-0.5, 0.5, (COUNT, 2)) * SIZE
        z = 10.0 + 0.004 * u[:, 0] if planar else rng.uniform(4, 40, COUNT)
        points = np.column_stack([u / FOCAL * z[:, None], z])
        seen = (points - t) @ R
        v = FOCAL * seen[:, :2] / np.maximum(seen[:, 2:], 0.1)
        good = (seen[:, 2] > 1) & np.all(np.abs(v) < 0.5 * SIZE, axis=1)
        first, second = np.concatenate([first, u[good]]), np.concatenate([second, v[good]])
    first, second = (p[:COUNT] + sigma * rng.normal(size=(COUNT, 2)) for p in (first, second))
    wrong = int(false * COUNT)
    second[:wrong] = rng.uniform(-0.5, 0.5, (wrong, 2)) * SIZE
    return first, second, R, t / step


def run(first, second, seed=0, dtype=np.float64, valid=None):
    arrays = (jnp.asarray(p / FOCAL, dtype) for p in (first, second))
    valid = np.ones(len(first), bool) if valid is None else valid
    return estimate(*arrays, jnp.asarray(valid), jax.random.key(seed))


def angle(fit, t):
    return np.degrees(np.arccos(np.clip(np.asarray(fit.value.direction.vector) @ t, -1, 1)))


@pytest.mark.slow
def test_as_near_as_magsac(x64):
    ours, theirs = [], []
    K = np.array([[FOCAL, 0, 0], [0, FOCAL, 0], [0, 0, 1]])
    for seed in range(25):
        first, second, _, t = pairs(seed)
        fit = run(first, second, seed)
        assert bool(fit.ok)
        singular = np.linalg.svd(fit.value.essential(), compute_uv=False)
        assert abs(singular[0] / singular[1] - 1) < 1e-6 and singular[2] < 1e-12
        ours.append(angle(fit, t))
        E, mask = cv2.findEssentialMat(second, first, K, cv2.USAC_MAGSAC, 0.999, 1.0)
        shift = cv2.recoverPose(E[:3], second, first, K, mask=mask)[2][:, 0]
        theirs.append(np.degrees(np.arccos(np.clip(shift @ t, -1, 1))))
    assert np.median(ours) < 1.2 * np.median(theirs) and np.max(ours) < 5.0


@pytest.mark.slow
def test_consistency(x64):
    """Under least squares, from the true pose: five degrees of freedom."""
    first, second, R, t = pairs(3, false=0.0, sigma=0.0)
    true = RelativePose(Direction(jnp.asarray(t)), SO3(jnp.asarray(R)))
    light = ConsensusOptions(hypotheses=32, pretest=64, finalists=4, refined=1)

    @jax.jit
    def squared(key):
        noise, draw = jax.random.split(key)
        moved = jnp.stack([jnp.asarray(p / FOCAL) for p in (first, second)])
        moved = moved + SIGMA / FOCAL * jax.random.normal(noise, moved.shape)
        fit = estimate_relative_pose(*moved, sigma=SIGMA / FOCAL, key=draw, loss=Quadratic(), consensus=light)
        return fit.gaussian().mahalanobis_squared(true), fit.ok

    nees, ok = jax.lax.map(squared, jax.random.split(jax.random.key(0), 200))
    # The mean's standard deviation is sqrt(10 / 200) = 0.22.
    assert ok.all() and 4.3 < nees.mean() < 5.7


@pytest.mark.slow
def test_gradients_equal_differences(x64):
    first, second, _, _ = pairs(1)

    def place(p):
        pose = run(first, p).value
        return jnp.concatenate([pose.direction.vector, pose.rotation.matrix()[0]])

    change = np.random.default_rng(0).normal(size=second.shape)
    slope = jax.jvp(lambda t: place(second + t * change), (0.0,), (1.0,))[1]
    difference = (place(second + 1e-3 * change) - place(second - 1e-3 * change)) / 2e-3
    np.testing.assert_allclose(slope, difference, rtol=1e-4, atol=1e-8)


@pytest.mark.slow
def test_masked_equals_absent(x64):
    first, second, _, _ = pairs(2)
    hole = second.copy()
    hole[150:] = np.nan
    masked, told = run(first, hole), run(first, second, valid=np.arange(COUNT) < 150)
    np.testing.assert_allclose(masked.value.essential(), told.value.essential(), atol=1e-9)


def degenerate(kind, seed):
    rng = np.random.default_rng(seed)
    first, second, _, _ = pairs(seed, false=0.2, step=1e-9 if kind == "rotation" else 1.0, planar=kind == "planar")
    if kind == "repeated":
        first[:], second[:] = first[:1], second[:1]
    if kind == "collinear":
        first[:, 1], second[:, 1] = 0.3 * first[:, 0], 0.3 * second[:, 0]
    if kind == "noise":
        second = rng.uniform(-0.5, 0.5, second.shape) * SIZE
    if kind == "nan":
        first[rng.uniform(size=COUNT) < 0.99] = np.nan
    return first / FOCAL, second / FOCAL


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["planar", "rotation", "repeated", "collinear", "noise", "nan", "empty"])
def test_degenerate_sets(kind):
    """Finite in value and derivative; the benchmark tries ten thousand sets."""
    sets = [degenerate(kind, seed) for seed in range(20)]
    first, second = (jnp.asarray(np.stack(p), jnp.float32) for p in zip(*sets, strict=True))
    valid = jnp.ones((20, COUNT), bool) & (kind != "empty")

    def total(a, b, valid, key):
        fit = estimate(a, b, valid, key)
        return jnp.sum(fit.value.essential()), fit

    each = jax.jit(lambda *sets: jax.lax.map(lambda s: jax.grad(total, argnums=(0, 1), has_aux=True)(*s), sets))
    slopes, fits = each(first, second, valid, jax.random.split(jax.random.key(0), 20))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((slopes, fits)))
    if kind == "planar":
        assert fits.ok.mean() > 0.8
    elif kind == "rotation":
        assert fits.ok.mean() < 0.1
    else:
        assert not fits.ok.any()
    refused = ~np.asarray(fits.ok)
    assert np.all(np.asarray(slopes[0])[refused] == 0)


def test_too_few_raise_an_error():
    with pytest.raises(ValueError, match="needs 5"):
        estimate_relative_pose(jnp.zeros((4, 2)), jnp.zeros((4, 2)), sigma=1e-3, key=jax.random.key(0))


def test_scale_is_free(x64):  # K-88
    """Twice the depth and twice the translation: the same images."""
    T = SE3.exp(jnp.array([0.6, 0.1, 0.3, 0.05, -0.1, 0.15]))
    points = jnp.asarray(np.random.default_rng(0).uniform(-2, 2, (10, 3)) + [0, 0, 6])
    far = SE3(T.rotation, 2.0 * T.translation)
    seen = [p[:, :2] / p[:, 2:] for p in (T.inverse().apply(points), far.inverse().apply(2.0 * points))]
    np.testing.assert_allclose(seen[0], seen[1], atol=1e-12)


@pytest.mark.slow
def test_inliers_are_a_mask_over_the_given_pairs(x64):
    """1 % of true pairs lie beyond the gate; a false pair lies within by chance."""
    first, second, _, _ = pairs(5)
    valid = np.arange(COUNT) % 7 > 0
    fit, wrong = run(first, second, 5, valid=valid), np.arange(COUNT) < int(0.4 * COUNT)
    inliers = np.asarray(fit.inliers)
    assert bool(fit.ok) and not inliers[~valid].any()
    assert inliers[valid & ~wrong].mean() > 0.95 and inliers[valid & wrong].mean() < 0.1
