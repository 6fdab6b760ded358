import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.poses import SE3
from jaxloc.sensors import BrownConrady, KannalaBrandt, Pinhole
from jaxloc.sensors.camera import kelly_camera, kelly_matrix, kelly_projection

INTRINSICS = (718.856, 716.2, 607.19, 185.2)
FIVE = (-0.28, 0.07, 0.0012, -0.0008, 0.01)
FISHEYE = (0.018, -0.011, 0.004, -0.0012)


def points_ahead(rng, dtype, n=40, width=0.6):
    z = rng.uniform(2.0, 40.0, n)
    return jnp.asarray(np.stack([z * rng.uniform(-width, width, n), z * rng.uniform(-width, width, n), z], -1), dtype)


def a_pose(dtype=np.float64):
    return SE3.from_euler(jnp.array([0.5, -0.3, 1.2], dtype), yaw=0.2, pitch=-0.1, roll=0.05)


def test_project_equals_opencv(x64, rng):  # T-13, T-16
    points, zero = points_ahead(rng, np.float64), np.zeros(3)
    expected, _ = cv2.projectPoints(np.asarray(points), zero, zero, camera_matrix(), np.array(FIVE))
    got = Pinhole(*INTRINSICS, lens=BrownConrady(FIVE)).project(points)
    assert np.abs(got - expected[:, 0]).max() < 1e-9
    expected, _ = cv2.fisheye.projectPoints(
        np.asarray(points)[:, None], zero, zero, camera_matrix(), np.array(FISHEYE), alpha=2.0 / INTRINSICS[0]
    )
    got = Pinhole(*INTRINSICS, skew=2.0, lens=KannalaBrandt(FISHEYE)).project(points)
    assert np.abs(got - expected[:, 0]).max() < 1e-9


def camera_matrix(skew=0.0):
    fx, fy, cx, cy = INTRINSICS
    return np.array([[fx, skew, cx], [0, fy, cy], [0, 0, 1]])


def test_bearing_equals_opencv(x64, rng):  # T-16
    camera = Pinhole(*INTRINSICS, lens=BrownConrady(FIVE))
    pixels = jnp.asarray(rng.uniform([200, 0], [1000, 370], (30, 2)))
    criteria = (cv2.TERM_CRITERIA_MAX_ITER + cv2.TERM_CRITERIA_EPS, 100, 1e-14)
    ideal = cv2.undistortPointsIter(np.asarray(pixels)[:, None], camera_matrix(), np.array(FIVE), None, None, criteria)
    rays = np.c_[ideal[:, 0], np.ones(30)]
    assert np.abs(camera.normalize(pixels) - ideal[:, 0]).max() * 718 < 1e-5
    assert np.allclose(camera.bearing(pixels), rays / np.linalg.norm(rays, axis=1, keepdims=True), atol=1e-8)


@pytest.mark.parametrize("lens", [None, BrownConrady, KannalaBrandt])
def test_unproject_inverts_project(dtype, rng, lens):  # T-15
    made = None if lens is None else lens(FIVE if lens is BrownConrady else FISHEYE)
    camera = Pinhole(*INTRINSICS, skew=1.5, lens=made)
    points = points_ahead(rng, dtype)
    back = camera.unproject(camera.project(points), points[:, 2])
    assert back.dtype == dtype and camera.skew.dtype == dtype
    assert np.allclose(
        back, points, rtol=2e-5 if dtype == np.float32 else 1e-11, atol=1e-4 if dtype == np.float32 else 0
    )
    assert bool(camera.in_front(points).all())


def test_matrix_round_trip_and_homogeneous_form(x64, rng):  # T-14, T-15
    camera, points = Pinhole(*INTRINSICS, skew=3.0), points_ahead(rng, np.float64)
    assert np.array_equal(camera.matrix(), camera_matrix(3.0))
    assert np.allclose(jax.tree.leaves(Pinhole.from_matrix(2.0 * camera.matrix())), jax.tree.leaves(camera))
    homogeneous = np.asarray(points) @ camera_matrix(3.0).T
    assert np.allclose(camera.project(points), homogeneous[:, :2] / homogeneous[:, 2:])


def test_full_projection_equals_the_stages(x64, rng):  # T-18, T-19
    camera, pose = Pinhole(*INTRINSICS, skew=3.0), a_pose()
    points_world = pose.apply(points_ahead(rng, np.float64))
    P = np.asarray(camera.projection_matrix(pose))
    R, t = np.asarray(pose.matrix())[:3, :3], np.asarray(pose.translation)
    assert np.allclose(P, camera_matrix(3.0) @ np.c_[R.T, -R.T @ t])
    homogeneous = np.c_[np.asarray(points_world), np.ones(40)] @ P.T
    staged = camera.project(pose.inverse().apply(points_world))
    assert np.allclose(staged, homogeneous[:, :2] / homogeneous[:, 2:])


def test_object_and_robot_localization_are_one_problem(x64, rng):  # K-15
    camera, T_world_camera = Pinhole(*INTRINSICS), a_pose()
    points_model = T_world_camera.apply(points_ahead(rng, np.float64))
    T_camera_model = T_world_camera.inverse()
    seen_from_robot = camera.project(T_world_camera.inverse().apply(points_model))
    seen_object = camera.project(T_camera_model.apply(points_model))
    assert np.allclose(seen_from_robot, seen_object)
    assert np.allclose((T_camera_model @ T_world_camera).matrix(), np.eye(4), atol=1e-12)


def test_points_without_an_image(dtype):
    camera = Pinhole(*INTRINSICS, lens=BrownConrady((-0.3, 0.0, 0.0, 0.0)))
    points = jnp.array([[0, 0, 5], [1, 2, 0], [1, 2, -3], [0, 0, 0], [1, 1, 1e-30], [30, 0, 10], [1e6, 0, 1e-5]], dtype)
    assert camera.in_front(points).tolist() == [True] + [False] * 6
    pixels, pull = jax.vjp(camera.project, points)
    (gradient,) = pull(jnp.ones_like(pixels))
    assert np.isfinite(pixels).all() and np.isfinite(gradient).all()
    assert np.allclose(gradient[1:5], 0.0)
    assert np.allclose(pixels[1:5], [INTRINSICS[2:]])


@pytest.mark.parametrize("lens", [None, BrownConrady(FIVE), KannalaBrandt(FISHEYE)])
def test_gradient_equals_differences(x64, rng, lens):
    lens = jax.tree.map(lambda leaf: leaf.astype(np.float64), lens)
    camera, points = Pinhole(*INTRINSICS, lens=lens), points_ahead(rng, np.float64, 5)
    jacobian = jax.vmap(jax.jacfwd(lambda p: camera.project(p[None])[0]))(points)
    for i in range(3):
        step = 1e-6 * np.eye(3)[i][None]
        difference = (camera.project(points + step) - camera.project(points - step)) / 2e-6
        assert np.allclose(jacobian[:, :, i], difference, rtol=1e-6, atol=1e-5)


def test_components_take_any_shape(dtype, rng):
    camera, points = Pinhole(*INTRINSICS), points_ahead(rng, dtype)
    grid = points.T.reshape(3, 5, 8)
    u, v = camera.project_components(*grid)
    assert np.allclose(np.stack([u, v], -1).reshape(40, 2), camera.project(points), rtol=1e-6)


def test_stack_of_cameras_and_jit(dtype, rng):
    focal = jnp.array([500.0, 700.0], dtype)
    cameras = jax.vmap(lambda f: Pinhole(f, f, 320.0, 240.0))(focal)
    points = points_ahead(rng, dtype)
    pixels = jax.vmap(lambda camera: camera.project(points))(cameras)
    alone = Pinhole(focal[1], focal[1], 320.0, 240.0)
    assert np.allclose(pixels[1], alone.project(points), rtol=1e-6)
    with jax.disable_jit():
        assert np.allclose(alone.project(points), pixels[1], rtol=1e-6)


def test_no_retrace_for_new_numbers(rng):
    traces = []

    @jax.jit
    def project(camera, points):
        traces.append(None)
        return camera.project(points)

    points = points_ahead(rng, np.float32)
    project(Pinhole(*INTRINSICS), points)
    project(Pinhole(jnp.float32(1.0), 2, 3.0, np.float32(4.0)), points)
    assert len(traces) == 1


def test_kelly_projection(x64, rng):  # K-8
    focal = 0.35
    points = np.stack([rng.uniform(-3, 3, 20), rng.uniform(1, 9, 20), rng.uniform(-3, 3, 20)], -1)
    printed = np.array([[1, 0, 0, 0], [0, 0, 0, 0], [0, 0, 1, 0], [0, 1 / focal, 0, 1]])
    assert np.allclose(kelly_matrix(jnp.array(focal)), printed)
    homogeneous = np.c_[points, np.ones(20)] @ printed.T
    got = kelly_projection(jnp.asarray(points), jnp.array(focal))
    assert np.allclose(got, homogeneous[:, [0, 2]] / homogeneous[:, 3:])
    assert np.allclose(got[:, 0], focal * points[:, 0] / (focal + points[:, 1]))
    behind = kelly_projection(jnp.array([[1.0, -1.0, 2.0], [1.0, -focal, 2.0]]), jnp.array(focal))
    assert np.allclose(behind, 0.0)


def test_kelly_camera_jacobian(x64, rng):  # K-9
    pose, focal = a_pose(), jnp.array(0.35)
    points = pose.apply(jnp.asarray(np.stack([rng.uniform(-3, 3, 6), rng.uniform(1, 9, 6), rng.uniform(-3, 3, 6)], -1)))
    P, T = np.asarray(kelly_matrix(focal)), np.linalg.inv(np.asarray(pose.matrix()))
    homogeneous = np.c_[np.asarray(points), np.ones(6)] @ (P @ T).T
    assert np.allclose(kelly_camera(pose, points, focal), homogeneous[:, [0, 2]] / homogeneous[:, 3:])
    h = lambda delta: kelly_camera(pose.retract(delta), points, focal)  # noqa: E731
    jacobian = jax.jacfwd(h)(jnp.zeros(6))
    for i in range(6):
        step = 1e-6 * jnp.eye(6)[i]
        assert np.allclose(jacobian[..., i], (h(step) - h(-step)) / 2e-6, atol=1e-8)
