import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import jaxloc as jl

LENS = (-0.3, 0.1, 0.001, -0.002, 0.0)
X, Y = (np.array(v) for v in ([5.0, 12.0, 40.0, 8.0], [0.5, -3.0, 6.0, -2.0]))


def camera(lens=None):
    return jl.sensors.Pinhole(520.0, 530.0, 322.0, 241.0, lens=lens)


def oracle(height, pitch, roll, lens=(0.0,) * 5):
    """OpenCV's projection by a rotation that SciPy makes: axes by name, then turned about y, then about the axis."""
    level = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # columns: right, down, forward
    turn = Rotation.from_euler("y", pitch).as_matrix() @ level @ Rotation.from_euler("z", roll).as_matrix()
    rotation, translation = turn.T, -turn.T @ np.array([0.0, 0.0, height])
    points = np.column_stack([X, Y, np.zeros(4)])
    matrix = np.array([[520.0, 0, 322.0], [0, 530.0, 241.0], [0, 0, 1]])
    return cv2.projectPoints(points, cv2.Rodrigues(rotation)[0], translation, matrix, np.array(lens))[0][:, 0]


@pytest.mark.parametrize("pitch, roll", [(0.0, 0.0), (0.06, 0.0), (-0.03, 0.05)])
def test_projection_is_that_of_opencv(x64, pitch, roll):
    ground = jl.sensors.GroundCamera(camera(jl.sensors.BrownConrady(LENS)), 1.4, pitch, roll)
    found = np.stack(ground.project_components(jnp.array(X), jnp.array(Y)), axis=1)
    np.testing.assert_allclose(found, oracle(1.4, pitch, roll, LENS), atol=1e-9)


def test_signs_are_those_of_the_docstring(x64):
    ahead = jnp.array([20.0])
    level, down, rolled = (jl.sensors.GroundCamera(camera(), 1.4, *angles) for angles in ((), (0.02,), (0.0, 0.1)))
    row = [float(g.project_components(ahead, 0.0 * ahead)[1][0]) for g in (level, down)]
    assert row[1] < row[0], "looking further down moves the road up in the image"
    # With the right side of the camera down, the horizon falls to the left in the image.
    left, right = (float(rolled.vanishing_point(jnp.array(h))[1]) for h in (0.2, -0.2))
    assert left > right


def test_pose_and_homography_agree(x64):
    ground = jl.sensors.GroundCamera(camera(), 1.4, 0.05, -0.02)
    points = jnp.column_stack([jnp.array(X), jnp.array(Y), jnp.zeros(4)])
    by_pose = ground.camera.project(ground.T_road_camera().inverse().apply(points))
    homogeneous = np.column_stack([X, Y, np.ones(4)]) @ np.array(ground.homography()).T
    by_plane = homogeneous[:, :2] / homogeneous[:, 2:]
    expected = np.stack(ground.project_components(points[:, 0], points[:, 1]), axis=1)
    np.testing.assert_allclose(by_pose, expected, atol=1e-9)
    np.testing.assert_allclose(by_plane, expected, atol=1e-8)
    with pytest.raises(ValueError, match="lens"):
        jl.sensors.GroundCamera(camera(jl.sensors.BrownConrady(LENS)), 1.4).homography()


@settings(max_examples=25, deadline=None)
@given(
    x=st.floats(3.0, 80.0),
    y=st.floats(-4.0, 4.0),
    height=st.floats(0.3, 3.0),
    pitch=st.floats(-0.05, 0.1),
)
def test_ground_of_a_pixel_is_where_the_pixel_came_from(x, y, height, pitch):
    ground = jl.sensors.GroundCamera(camera(), height, pitch, 0.02)
    x, y = jnp.array([x]), jnp.array([y])
    u, v = ground.project_components(x, y)
    assert bool(ground.meets_ground_components(u, v)[0])
    back = ground.to_ground_components(u, v)
    np.testing.assert_allclose(back[0], x, rtol=0.01)
    np.testing.assert_allclose(back[1], y, atol=0.05)


def test_vanishing_point_is_where_parallel_lines_meet(x64):
    ground = jl.sensors.GroundCamera(camera(), 1.4, 0.05, -0.02)
    far = jnp.array([1e6, 1e6])
    u, v = ground.project_components(far * np.cos(0.1), far * np.sin(0.1) + jnp.array([-2.0, 2.0]))
    point = ground.vanishing_point(jnp.array(0.1))
    np.testing.assert_allclose(np.array([u, v]), np.array(point)[:, None] * np.ones(2), atol=1e-2)
    level = jl.sensors.GroundCamera(camera(), 1.4, 0.05)
    np.testing.assert_allclose(float(level.horizon()), 241.0 - 530.0 * np.tan(0.05), atol=1e-9)


def test_above_the_horizon_is_no_ground():
    ground = jl.sensors.GroundCamera(camera(), 1.4, 0.05)
    u, v = jnp.array([300.0, 300.0, jnp.nan]), jnp.array([10.0, 470.0, 300.0])
    assert ground.meets_ground_components(u, v).tolist() == [False, True, False]

    def total(height):
        moved = eqx.tree_at(lambda g: g.height, ground, height)
        x, y = moved.to_ground_components(u[:2], v[:2])
        return jnp.sum(x + y)

    assert np.isfinite(jax.grad(total)(ground.height))
    assert not bool(ground.sees_components(jnp.array([-5.0]), jnp.array([0.0]))[0])


def test_gradients_of_the_projection(x64):
    def total(numbers):
        ground = jl.sensors.GroundCamera(camera(jl.sensors.BrownConrady(LENS)), *numbers)
        u, v = ground.project_components(jnp.array(X), jnp.array(Y))
        return jnp.sum(u * jnp.arange(4.0) + v)

    at, step = jnp.array([1.4, 0.05, -0.02]), 1e-6
    slopes = [(total(at.at[i].add(step)) - total(at.at[i].add(-step))) / (2 * step) for i in range(3)]
    np.testing.assert_allclose(jax.grad(total)(at), slopes, rtol=1e-6)


def test_lane_center_is_a_clothoid(x64):
    """Against the exact curve, integrated: its direction changes by 0.05 rad here."""
    lane = jl.lanes.Lane(0.4, 0.01, 5e-4, 1e-5)
    s = np.linspace(0.0, 60.0, 6001)
    angle = -0.01 + 5e-4 * s + 0.5e-5 * s**2
    x = np.concatenate([[0.0], np.cumsum(np.cos(0.5 * (angle[1:] + angle[:-1])) * 0.01)])
    y = np.concatenate([[0.0], np.cumsum(np.sin(0.5 * (angle[1:] + angle[:-1])) * 0.01)]) - 0.4 * np.cos(0.01)
    found = lane.center(jnp.array(x))
    np.testing.assert_allclose(found, y, atol=2e-3)
    np.testing.assert_allclose(lane.direction(jnp.array(x)), angle, atol=1e-3)
    np.testing.assert_allclose(lane.lateral(jnp.array(x), jnp.array(y)), 0.0, atol=2e-3)


def test_a_lane_moves_as_the_vehicle_drives(x64):
    """The lane from a place further on is the same curve, seen from there."""
    lane, ahead = jl.lanes.Lane(0.3, 0.004, 8e-4, -2e-6), jnp.linspace(0.0, 20.0, 5)
    distance, turn = jnp.array(2.0), jnp.array(0.003)
    later = lane.advance(distance, turn)
    # The vehicle's own path: an arc of the turn over the distance.
    path = jl.poses.SE2.exp(jnp.array([2.0, 0.0, 0.003]))
    here = path.apply(jnp.stack([ahead, later.center(ahead)], axis=1))
    np.testing.assert_allclose(lane.center(here[:, 0]), here[:, 1], atol=1e-4)


def test_dtype_is_kept(dtype):
    ground = jl.sensors.GroundCamera(
        jax.tree.map(lambda leaf: leaf.astype(dtype), camera()), jnp.array(1.4, dtype), jnp.array(0.05, dtype)
    )
    x = jnp.array(X, dtype)
    assert all(leaf.dtype == dtype for leaf in ground.project_components(x, x))
    assert all(leaf.dtype == dtype for leaf in ground.to_ground_components(x, 100.0 * x))
    lane = jl.lanes.Lane(*(jnp.array(v, dtype) for v in (0.1, 0.0, 1e-3)))
    assert lane.center(x).dtype == dtype
