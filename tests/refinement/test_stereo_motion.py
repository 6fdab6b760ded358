"""Motion of a stereo rig: covariance, masks, outliers and degenerate sets."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2

from jaxloc.poses import SE3
from jaxloc.refinement import refine_motion, refine_pose
from jaxloc.sensors import Pinhole, StereoRig
from jaxloc.solvers import GemanMcClure


def rig_at(dtype):
    return StereoRig(Pinhole(*(jnp.asarray(x, dtype) for x in (718.0, 718.0, 607.0, 185.0))), 0.54)


MOTION = np.array([0.02, -0.01, 1.0, 0.003, 0.02, -0.002])


def drives(rng, seeds, count=60, noise=0.5):
    """Points of a street from 5 to 60 m, seen before and after a motion of 1 m."""
    z = rng.uniform(5.0, 60.0, (seeds, count, 1))
    u, v = rng.uniform(50.0, 1150.0, (seeds, count, 1)), rng.uniform(20.0, 350.0, (seeds, count, 1))
    points = np.concatenate([(u - 607.0) / 718.0 * z, (v - 185.0) / 718.0 * z, z], axis=2)
    matrix = np.asarray(SE3.exp(jnp.asarray(MOTION, jnp.float32)).matrix(), float)
    after = (points - matrix[:3, 3]) @ matrix[:3, :3]
    rig = rig_at(np.float32)
    measured = [jax.vmap(rig.project)(jnp.asarray(p, jnp.float32)) for p in (points, after)]
    return [m + jnp.asarray(noise * rng.normal(size=m.shape), jnp.float32) for m in measured]


@eqx.filter_jit
def motions(previous, current, noise):
    truth = SE3.exp(jnp.asarray(MOTION, jnp.float32))
    covariance = noise**2 * jnp.eye(3, dtype=previous.dtype)

    def lane(a, b):
        rig, initial = rig_at(np.float32), SE3.identity(jnp.float32)
        found = refine_motion(rig, a, b, initial, covariance_previous=covariance, covariance_current=covariance)
        left = refine_pose(rig.camera, rig.triangulate(a), b[:, jnp.array([0, 2])], initial)
        errors = truth.local(found.value), truth.local(left.value)
        return found.gaussian().mahalanobis_squared(truth), found.ok, errors

    return jax.vmap(lane)(previous, current)


@pytest.mark.slow
def test_motion_is_consistent_and_better_than_one_camera(rng):  # K-86, K-87, T-72
    nees, ok, (errors, plain) = motions(*drives(rng, 400), jnp.asarray(0.5, jnp.float32))
    assert np.all(ok)
    low, high = chi2.ppf([0.005, 0.995], 6 * 400) / 400
    assert low < np.mean(nees) < high
    rms, rms_plain = (np.sqrt(np.mean(np.sum(np.asarray(e)[:, :3] ** 2, axis=1))) for e in (errors, plain))
    assert rms < 0.8 * rms_plain


@pytest.mark.slow
def test_motion_without_noise_is_exact(dtype, rng):
    previous, current = (x[0].astype(dtype) for x in drives(rng, 1, noise=0.0))
    found = refine_motion(rig_at(dtype), previous, current, SE3.identity(dtype))
    assert bool(found.ok) and found.covariance.dtype == dtype
    np.testing.assert_allclose(found.value.log(), MOTION, atol=1e-3)


@pytest.mark.slow
def test_motion_masked_equals_absent(x64, rng):
    previous, current = (x[0].astype(np.float64) for x in drives(rng, 1))
    masked_current = current.at[50:].set(jnp.nan)
    rig, initial = rig_at(np.float64), SE3.identity()
    masked = refine_motion(rig, previous, masked_current, initial, valid=jnp.arange(60) < 50)
    absent = refine_motion(rig, previous[:50], current[:50], initial)
    np.testing.assert_allclose(masked.value.matrix(), absent.value.matrix(), atol=1e-10)
    np.testing.assert_allclose(masked.covariance, absent.covariance, rtol=1e-7, atol=1e-14)
    one_each = jnp.tile(jnp.eye(3)[None], (60, 1, 1))
    each = refine_motion(rig, previous, current, initial, covariance_previous=one_each, covariance_current=one_each)
    alike = refine_motion(rig, previous, current, initial)
    np.testing.assert_allclose(each.value.matrix(), alike.value.matrix(), atol=1e-12)


@pytest.mark.slow
def test_motion_with_outliers_under_a_robust_kernel(rng):
    previous, current = (x[0] for x in drives(rng, 1))
    current = current.at[:12].add(jnp.asarray(rng.uniform(-40.0, 40.0, (12, 3)), jnp.float32))
    found = refine_motion(
        rig_at(np.float32), previous, current, SE3.exp(jnp.asarray(MOTION + 0.01, jnp.float32)), loss=GemanMcClure(3.0)
    )
    assert bool(found.ok)
    np.testing.assert_allclose(found.value.log(), MOTION, atol=0.08)


@pytest.mark.slow
def test_degenerate_motions_are_flagged_and_finite(rng):
    previous, current = (x[0] for x in drives(rng, 1))
    everything = jnp.ones(60, bool)
    cases = [
        (previous, current, jnp.arange(60) < 2),
        (previous, current, ~everything),
        (previous.at[:, 0].set(previous[:, 1] - 1.0), current, everything),
        (jnp.full_like(previous, jnp.nan), current, everything),
        (jnp.tile(previous[:1], (60, 1)), jnp.tile(current[:1], (60, 1)), everything),
        (previous, current, everything),
    ]
    batch = [jnp.stack(x) for x in zip(*cases, strict=True)]

    def lane(previous, current, valid):
        initial = SE3.identity(jnp.float32)
        found = refine_motion(rig_at(np.float32), previous, current, initial, valid=valid)
        return jnp.sum(found.value.matrix()) + 1e-12 * jnp.sum(found.covariance), found.ok

    run = jax.jit(jax.vmap(jax.value_and_grad(lane, argnums=(0, 1), has_aux=True)))
    (values, ok), gradients = run(*batch)
    assert ok.tolist() == [False] * 5 + [True] and np.all(np.isfinite(values))
    for gradient in gradients:
        assert np.all(np.isfinite(gradient)) and not np.any(gradient[:5])
