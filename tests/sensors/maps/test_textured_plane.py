"""Prediction of an image from a map [K-11, K-17, K-18, K-45]: OpenCV's warps are the oracle."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.poses import SE3
from jaxloc.sensors import BrownConrady, Pinhole, TexturedPlane

CAMERA = (110.0, 105.0, 40.0, 30.0)
SHAPE = (60, 80)


@pytest.fixture
def plane(rng):
    texture = cv2.GaussianBlur(rng.uniform(0, 255, (70, 90)), (0, 0), 2)
    return TexturedPlane(jnp.asarray(texture), 0.02, SE3.from_euler(jnp.array([0.3, -0.2, 1.0]), 0.1, 0.2, -0.1))


def looking(plane, height=1.2):
    offset = SE3.exp(jnp.array([0.9, 0.7, -height, 0.05, -0.1, 0.2]))
    return plane.T_world_plane @ offset


def test_prediction_equals_a_warped_map(rng, x64):
    texture = cv2.GaussianBlur(rng.uniform(0, 255, (70, 90)), (0, 0), 2)
    plane = TexturedPlane(jnp.asarray(texture), 0.02, SE3.from_euler(jnp.array([0.3, -0.2, 1.0]), 0.1, 0.2, -0.1))
    camera, pose = Pinhole(*CAMERA), looking(plane)
    matrix = np.asarray(plane.homography(camera, pose).matrix())
    expected = cv2.warpPerspective(texture, matrix, SHAPE[::-1], flags=cv2.INTER_LINEAR)
    found = plane.predict(camera, pose, shape=SHAPE)
    seen = cv2.erode(np.asarray(found.seen).astype(np.uint8), np.ones((5, 5))).astype(bool)
    assert seen.mean() > 0.4
    # OpenCV rounds coordinates to 1/32 px.
    np.testing.assert_allclose(np.asarray(found.image)[seen], expected[seen], atol=1.5)


def test_homography_and_projection_agree(rng, x64):
    plane = TexturedPlane(jnp.asarray(rng.uniform(size=(7, 9))), 0.02, SE3.exp(jnp.asarray(rng.normal(size=6) * 0.2)))
    camera, pose = Pinhole(*CAMERA, skew=1.5), looking(plane)
    pixels = jnp.asarray(rng.uniform(0, 8, (6, 2)))
    direct = camera.project(pose.inverse().apply(plane.points(pixels)))
    np.testing.assert_allclose(plane.homography(camera, pose).apply(pixels), direct, atol=1e-9)
    # Image to image over the plane, K-17: x2 = H2 H1^-1 x1.
    other = pose @ SE3.exp(jnp.array([0.1, 0.0, 0.2, 0.0, 0.05, 0.0]))
    between = plane.homography(camera, other) @ plane.homography(camera, pose).inverse()
    np.testing.assert_allclose(
        between.apply(direct), camera.project(other.inverse().apply(plane.points(pixels))), atol=1e-8
    )


def test_lens_and_gradient(rng, x64):
    texture = cv2.GaussianBlur(rng.uniform(0, 255, (70, 90)), (0, 0), 3)
    plane = TexturedPlane(jnp.asarray(texture), 0.02, SE3.identity())
    camera, pose = Pinhole(*CAMERA, lens=BrownConrady((-0.2, 0.05, 0.0, 0.0, 0.0))), looking(plane)
    pixels = jnp.array([[40.0, 30.0], [47.0, 36.0]])
    uv = camera.project(pose.inverse().apply(plane.points(pixels)))
    column, row = int(round(float(uv[0, 0]))), int(round(float(uv[0, 1])))
    found = plane.predict(camera, pose, shape=SHAPE).image
    assert abs(float(found[row, column]) - texture[30, 40]) < 6
    with pytest.raises(ValueError, match="lens"):
        plane.homography(camera, pose)
    value = lambda d: jnp.sum(plane.predict(camera, pose.retract(d), shape=SHAPE).image[20:40, 25:50] ** 2)  # noqa: E731
    direction = jnp.asarray(rng.normal(size=6))
    slope = jax.jvp(value, (jnp.zeros(6),), (direction,))[1]
    numeric = (value(1e-6 * direction) - value(-1e-6 * direction)) / 2e-6
    assert abs(float(slope - numeric)) < 1e-3 * abs(float(numeric))


def test_a_camera_that_looks_away_sees_nothing(plane):
    away = (
        plane.T_world_plane
        @ SE3.exp(jnp.array([0.9, 0.7, -1.0, 0.0, 0.0, 0.0]))
        @ SE3.exp(jnp.zeros(6).at[3].set(np.pi))
    )
    along = plane.T_world_plane @ SE3.exp(jnp.array([0.9, 0.7, 0.0, 0.0, 0.0, 0.0]))
    for pose in (away, along):
        found = plane.predict(Pinhole(*CAMERA), pose, shape=SHAPE)
        assert not np.any(found.seen) and np.all(np.asarray(found.image) == 0)
        slope = jax.jacfwd(lambda d: plane.predict(Pinhole(*CAMERA), pose.retract(d), shape=SHAPE).image.sum())  # noqa: B023
        assert np.all(np.isfinite(slope(jnp.zeros(6))))
