"""Motions from stereo matches with outliers: K-86...K-90, T-72."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.beliefs import chi2_quantile
from jaxloc.data.simulate import stereo_points as simulate_points
from jaxloc.odometry import estimate_disparity_offset, estimate_motion
from jaxloc.poses import SE3
from jaxloc.refinement import StereoMatches

pytestmark = pytest.mark.heavy

NOISE = 0.5


def matches_of(pair):
    noise = NOISE**2 * jnp.eye(3, dtype=pair.previous.dtype)
    return StereoMatches.of(pair.previous, pair.current, noise, noise, None)


@eqx.filter_jit
def motions(rig, pairs, predictions, keys):
    def one(pair, prediction, key):
        return estimate_motion(rig, matches_of(pair), prediction, key=key)

    return jax.vmap(one)(pairs, predictions, keys)


def simulate(num_pairs):
    """Independent frame pairs with a quarter of outliers."""
    rig = simulate_points.kitti_rig()
    return rig, simulate_points.simulate_stereo_points(key=jax.random.key(5), rig=rig, num_frames=num_pairs + 1).pairs


@pytest.fixture(scope="module")
def drive():
    """Motions of 240 pairs, started at the motion before."""
    rig, pairs = simulate(240)
    before = jax.tree.map(lambda leaf: jnp.concatenate([leaf[:1], leaf[:-1]]), pairs.motion)
    found = motions(rig, pairs, before, jax.random.split(jax.random.key(6), 240))
    return rig, pairs, found


@pytest.mark.slow
def test_every_motion_is_found_without_outliers_among_the_inliers(drive):
    _, pairs, found = drive
    assert found.estimate.ok.all()
    wrong = found.inliers & ~pairs.is_inlier
    missed = ~found.inliers & pairs.is_inlier
    assert float(jnp.mean(jnp.sum(wrong, axis=1))) < 0.5
    assert float(jnp.mean(jnp.sum(missed, axis=1))) < 2.0


@pytest.mark.slow
def test_covariance_is_honest(drive):
    """NEES of 6 and 95 % coverage over 240 seeds."""
    _, pairs, found = drive
    squared = jax.vmap(lambda e, t: e.gaussian().mahalanobis_squared(t))(found.estimate, pairs.motion)
    assert 5.4 < float(jnp.mean(squared)) < 6.6
    assert 0.92 < float(jnp.mean(squared < chi2_quantile(0.95, 6))) < 0.98


@pytest.mark.slow
def test_errors_show_no_bias(drive):
    """Mean error below three standard errors of the mean in every direction."""
    _, pairs, found = drive
    errors = np.asarray(jax.vmap(lambda t, e: t.local(e))(pairs.motion, found.estimate.value))
    assert (np.abs(errors.mean(axis=0)) < 3.5 * errors.std(axis=0) / np.sqrt(len(errors))).all()


@pytest.mark.slow
def test_a_prediction_that_is_far_off_is_overruled_by_samples(drive):
    rig, pairs, found = drive
    far = jax.vmap(lambda t: t @ SE3.exp(jnp.array([1.0, 0.0, -2.0, 0.0, 0.15, 0.0])))(pairs.motion)
    again = motions(rig, pairs, far, jax.random.split(jax.random.key(1), 240))
    difference = jax.vmap(lambda a, b: a.local(b))(found.estimate.value, again.estimate.value)
    assert again.estimate.ok.all()
    assert float(jnp.max(jnp.abs(difference))) < 2e-3


@pytest.mark.slow
def test_without_information_there_is_no_motion_and_no_nan():
    """All points the same, no disparity, nan everywhere, ten points only: each in one lane of a batch of good ones."""
    rig, pairs = simulate(8)
    previous, current = pairs.previous, pairs.current
    previous = previous.at[0].set(previous[0, :1]).at[1, :, 1].set(previous[1, :, 0]).at[2].set(jnp.nan)
    previous = previous.at[3, 10:].set(jnp.nan)
    current = current.at[0].set(current[0, :1])
    lame = eqx.tree_at(lambda p: (p.previous, p.current), pairs, (previous, current))
    again = motions(rig, lame, pairs.motion, jax.random.split(jax.random.key(6), 8))
    assert not again.estimate.ok[:4].any() and again.estimate.ok[4:].all()
    assert all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(eqx.filter(again, eqx.is_inexact_array)))


@pytest.mark.slow
def test_disparity_offset_is_recovered(drive):
    """A constant 0.7 px taken off all disparities comes back from near and far points together."""
    rig, pairs, found = drive

    @eqx.filter_jit
    def offset(pair, truth, key):
        shift = jnp.array([0.0, 0.7, 0.0])[None]
        matches = matches_of(
            eqx.tree_at(lambda p: (p.previous, p.current), pair, (pair.previous + shift, pair.current + shift))
        )
        motion = estimate_motion(rig, matches, truth, key=key)
        return estimate_disparity_offset(rig, matches, motion)

    estimates = jax.vmap(offset)(pairs, pairs.motion, jax.random.split(jax.random.key(2), 240))
    values = np.asarray(estimates.value[1])
    weights = 1 / np.asarray(estimates.covariance[:, 6, 6])
    mean = (weights * values).sum() / weights.sum()
    assert abs(mean - 0.7) < 4 / np.sqrt(weights.sum()) + 0.02
