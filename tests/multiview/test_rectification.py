"""Rectification: OpenCV's rotations and maps, equal rows, pairs that cannot be."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.images.interpolation import sample
from jaxloc.multiview.rectification import rectification_map, rectify, rectifying_homographies
from jaxloc.poses import SE3, SO3
from jaxloc.sensors import BrownConrady, Pinhole

SHAPE = (48, 64)


def pair():
    left = Pinhole(52.0, 53.0, 31.0, 24.5, 0.0, BrownConrady(jnp.array([-0.2, 0.05, 1e-3, -1e-3, 0.01])))
    right = Pinhole(51.0, 50.5, 32.5, 22.5, 0.0, BrownConrady(jnp.array([-0.15, 0.02, 0.0, 2e-3, 0.0])))
    pose = SE3.from_euler(jnp.array([0.12, 0.01, -0.006]), yaw=0.03, pitch=-0.05, roll=0.02)
    return left, right, pose


def numpy_of(camera):
    return np.asarray(camera.matrix(), np.float64), np.asarray(camera.lens.coefficients, np.float64)


def test_rotations_and_maps_are_those_of_opencv(x64):
    left, right, pose = pair()
    found = rectify(left, right, pose, shape=SHAPE)
    inverse = pose.inverse()
    size, (k1, d1), (k2, d2) = SHAPE[::-1], numpy_of(left), numpy_of(right)
    rotation, translation = np.asarray(inverse.rotation.matrix()), np.asarray(inverse.translation)
    r1, r2, _, p2, *_ = cv2.stereoRectify(k1, d1, k2, d2, size, rotation, translation)
    np.testing.assert_allclose(found.R_rectified_left.matrix(), r1, atol=1e-12)
    np.testing.assert_allclose(found.R_rectified_right.matrix(), r2, atol=1e-12)
    assert bool(found.ok) and float(found.rig.baseline) == pytest.approx(-p2[0, 3] / p2[0, 0])
    new = np.asarray(found.rig.camera.matrix())
    for camera, turn, (k, d) in ((left, found.R_rectified_left, (k1, d1)), (right, found.R_rectified_right, (k2, d2))):
        expected = cv2.initUndistortRectifyMap(k, d, np.asarray(turn.matrix()), new, size, cv2.CV_32FC1)
        maps = np.asarray(rectification_map(camera, turn, found.rig.camera, shape=SHAPE))
        known = (maps >= 0).all(axis=-1)
        assert known.mean() > 0.9
        np.testing.assert_allclose(maps[known], np.stack(expected, axis=-1)[known], atol=1e-4)


def test_rows_are_equal(x64, rng):
    """Points seen by both cameras lie in one row, at the disparity of their depth [T-21]."""
    left, right, pose = pair()
    found = rectify(left, right, pose, shape=SHAPE)
    points = jnp.asarray(np.column_stack([rng.uniform(-0.5, 0.5, (20, 2)), rng.uniform(1.0, 4.0, 20)]))
    measured = []
    for camera, turn, pixels in (
        (left, found.R_rectified_left, left.project(points)),
        (right, found.R_rectified_right, right.project(pose.inverse().apply(points))),
    ):
        rays = jnp.concatenate([camera.normalize(pixels), jnp.ones((20, 1))], axis=1)
        measured.append(found.rig.camera.project(turn.apply(rays)))
    np.testing.assert_allclose(measured[0][:, 1], measured[1][:, 1], atol=1e-9)
    triangulated = found.rig.triangulate(jnp.column_stack([measured[0][:, 0], measured[1][:, 0], measured[0][:, 1]]))
    np.testing.assert_allclose(found.R_rectified_left.inverse().apply(triangulated), points, atol=1e-8)


def test_maps_read_pictures_like_opencv(dtype, rng):
    left, right, pose = jax.tree.map(lambda leaf: leaf.astype(dtype), pair())
    found = rectify(left, right, pose, shape=SHAPE)
    assert found.rig.camera.fx.dtype == dtype
    maps = rectification_map(left, found.R_rectified_left, found.rig.camera, shape=SHAPE)
    assert maps.dtype == dtype and maps.shape == (*SHAPE, 2)
    image = cv2.GaussianBlur(rng.uniform(0, 255, SHAPE).astype(np.float32), (0, 0), 2.0)
    ours = sample(jnp.asarray(image, dtype), maps.reshape(-1, 2))
    columns, rows = np.moveaxis(np.asarray(maps, np.float32), -1, 0)
    theirs = cv2.remap(image, np.ascontiguousarray(columns), np.ascontiguousarray(rows), cv2.INTER_LINEAR)
    inside = np.asarray(ours.inside)
    assert inside.mean() > 0.5
    # OpenCV rounds positions to a 32nd of a pixel.
    np.testing.assert_allclose(np.asarray(ours.values)[inside], theirs.ravel()[inside], atol=1.0)


def test_aligned_cameras_stay(dtype):
    camera = Pinhole(*jnp.array([50.0, 50.0, 31.5, 23.5], dtype))
    pose = SE3(SO3.identity(dtype), jnp.array([0.1, 0.0, 0.0], dtype))
    found = rectify(camera, camera, pose, shape=SHAPE)
    np.testing.assert_allclose(found.R_rectified_left.matrix(), np.eye(3), atol=1e-7)
    np.testing.assert_allclose(found.rig.camera.matrix(), camera.matrix(), atol=1e-4)
    identity = rectification_map(camera, SO3.identity(dtype), camera, shape=SHAPE)
    np.testing.assert_allclose(identity, np.stack(np.meshgrid(range(64), range(48)), axis=-1), atol=1e-4)


@pytest.mark.parametrize("translation", [(0.0, 0.0, 0.0), (-0.1, 0.0, 0.0), (0.0, 0.1, 0.0), (np.nan, 0.0, 0.0)])
def test_pairs_that_are_none(translation):
    left, right, pose = pair()
    found = rectify(left, right, SE3(pose.rotation, jnp.array(translation)), shape=SHAPE)
    assert not bool(found.ok)
    assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(found))
    assert bool(jnp.isfinite(rectification_map(left, found.R_rectified_left, found.rig.camera, shape=SHAPE)).all())


def test_gradient(x64):
    left, right, pose = pair()

    def row(twist):
        found = rectify(left, right, pose.retract(twist), shape=SHAPE)
        return rectification_map(left, found.R_rectified_left, found.rig.camera, shape=SHAPE)[20, 30, 1]

    step = 1e-6
    numeric = [(row(step * e) - row(-step * e)) / (2 * step) for e in jnp.eye(6)]
    np.testing.assert_allclose(jax.grad(row)(jnp.zeros(6)), numeric, rtol=1e-5, atol=1e-6)


def uncalibrated(rng, turn=(0.05, -0.1, 0.15), step=(0.9, 0.1, 0.2)):
    """Points in two images of a camera that turned and moved, and the fundamental matrix ``x1^T F x2 = 0``."""
    K = np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]])
    T = SE3(SO3.exp(jnp.asarray(turn)), jnp.asarray(step))
    points = np.column_stack([rng.uniform(-1, 2, (40, 1)), rng.uniform(-1, 1, (40, 1)), rng.uniform(4, 9, (40, 1))])
    x, y, z = step
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ np.asarray(T.rotation.matrix())
    inverse = np.linalg.inv(K)
    seen = [p @ K.T for p in (points, np.asarray(T.inverse().apply(jnp.asarray(points))))]
    return inverse.T @ essential @ inverse, *(jnp.asarray(p[:, :2] / p[:, 2:]) for p in seen)


def test_rectifying_homographies_make_rows_equal(x64, rng):
    F, first, second = uncalibrated(rng)
    pair = rectifying_homographies(jnp.asarray(F), first, second, shape=(480, 640))
    left, right = pair.first.apply(first), pair.second.apply(second)
    assert bool(pair.ok)
    np.testing.assert_allclose(left[:, 1], right[:, 1], atol=1e-8)
    # OpenCV's rows are equal too, and its columns no nearer.
    _, one, two = cv2.stereoRectifyUncalibrated(np.array(first), np.array(second), F.T, (640, 480))
    theirs = [cv2.perspectiveTransform(np.array(p)[None], h)[0] for p, h in ((first, one), (second, two))]
    np.testing.assert_allclose(theirs[0][:, 1], theirs[1][:, 1], atol=1e-3)
    assert np.square(left - right).sum() <= 1.01 * np.square(theirs[0] - theirs[1]).sum()
    corners = jnp.array([[0.0, 0.0], [639.0, 0.0], [639.0, 479.0], [0.0, 479.0]])
    assert np.abs(pair.second.apply(corners) - corners).max() < 250.0


def test_an_epipole_in_the_picture_is_told(x64, rng):
    F, first, second = uncalibrated(rng, step=(0.0, 0.0, 1.0))
    blank = jnp.full_like(first, jnp.nan)
    for matrix, points in ((F, first), (np.zeros((3, 3)), first), (np.full((3, 3), np.nan), first), (F, blank)):
        pair = rectifying_homographies(jnp.asarray(matrix), points, second, shape=(480, 640))
        assert not bool(pair.ok)
        np.testing.assert_array_equal(pair.first.matrix(), np.eye(3))
