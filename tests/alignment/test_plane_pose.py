"""A pose straight from the pixels of a map image [K-11, K-12, K-45]."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2

from jaxloc.alignment import plane_pose
from jaxloc.images import Bicubic
from jaxloc.poses import SE3
from jaxloc.sensors import Pinhole, TexturedPlane

CAMERA, SHAPE = Pinhole(100.0, 100.0, 47.5, 35.5), (72, 96)


@pytest.fixture(scope="module")
def scene():
    rng = np.random.default_rng(0)
    texture = cv2.GaussianBlur(rng.uniform(0, 255, (128, 128)), (0, 0), 3.0)
    texture = 120 + 40 * (texture - texture.mean()) / texture.std()
    plane = TexturedPlane(
        jnp.asarray(texture, jnp.float32), 0.02, SE3.from_euler(jnp.array([1.0, 2.0, 0.5]), 0.3, 0.1, 0.0)
    )
    pose = plane.T_world_plane @ SE3.exp(jnp.array([1.25, 1.25, -1.4, 0.08, -0.05, 0.1]))
    photo = plane.predict(CAMERA, pose, shape=SHAPE, method=Bicubic())
    assert bool(jnp.all(photo.seen))
    return plane, pose, photo.image


@pytest.mark.slow
def test_pose_is_found_under_another_exposure(scene):
    plane, truth, photo = scene
    rng = np.random.default_rng(1)
    dark = np.uint8(np.clip(0.6 * np.asarray(photo) + 25 + rng.normal(size=SHAPE), 0, 255))
    start = truth @ SE3.exp(jnp.array([0.04, -0.03, 0.06, 0.01, -0.01, 0.03]))
    fit = plane_pose.refine_pose(dark, plane, CAMERA, start)
    error = truth.local(fit.value)
    assert bool(fit.ok)
    assert float(jnp.linalg.norm(error[:3])) < 0.004 and float(jnp.linalg.norm(error[3:])) < 0.004
    assert float(fit.gaussian().mahalanobis_squared(truth)) < 25


@pytest.mark.slow
def test_covariance_is_consistent(scene):
    plane, truth, photo = scene
    rng = np.random.default_rng(2)
    photos = jnp.asarray(np.asarray(photo) + 3.0 * rng.normal(size=(40, *SHAPE)), jnp.float32)

    def squared(noisy):
        fit = plane_pose.refine_pose(noisy, plane, CAMERA, truth, levels=1, stride=1, sigma=3.0)
        return fit.gaussian().mahalanobis_squared(truth), fit.ok

    values, ok = jax.lax.map(squared, photos)
    assert bool(jnp.all(ok))
    low, high = chi2.ppf([0.005, 0.995], 6 * 40) / 40
    assert low < float(jnp.mean(values)) < high


@pytest.mark.slow
def test_degenerate_inputs_are_flagged(scene):
    plane, truth, photo = scene
    away = truth @ SE3.exp(jnp.array([0.0, 0.0, 0.0, np.pi, 0.0, 0.0]))
    flat = TexturedPlane(jnp.full((128, 128), 90.0), 0.02, plane.T_world_plane)
    for fit in (
        plane_pose.refine_pose(photo, plane, CAMERA, away),
        plane_pose.refine_pose(photo, flat, CAMERA, truth),
        plane_pose.refine_pose(jnp.full(SHAPE, jnp.nan), plane, CAMERA, truth),
    ):
        assert not bool(fit.ok)
        assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(fit))
