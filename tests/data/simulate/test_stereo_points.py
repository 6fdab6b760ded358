import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.data.simulate.stereo_points import kitti_rig, simulate_drive, simulate_pair, simulate_stereo_points
from jaxloc.poses import SE3


def numpy_measurements(rig, points):
    """The pinhole and disparity equations, written out."""
    fx, fy, cx, cy = (float(x) for x in (rig.camera.fx, rig.camera.fy, rig.camera.cx, rig.camera.cy))
    u = fx * points[:, 0] / points[:, 2] + cx
    return np.column_stack([u, u - fx * float(rig.baseline) / points[:, 2], fy * points[:, 1] / points[:, 2] + cy])


def numpy_points(rig, measured):
    fx, fy, cx, cy = (float(x) for x in (rig.camera.fx, rig.camera.fy, rig.camera.cx, rig.camera.cy))
    z = fx * float(rig.baseline) / (measured[:, 0] - measured[:, 1])
    return np.column_stack([(measured[:, 0] - cx) / fx * z, (measured[:, 2] - cy) / fy * z, z])


def test_without_noise_the_motion_explains_all_true_matches(x64):
    motion = SE3.exp(jnp.array([0.1, -0.05, 1.0, 0.01, 0.03, -0.02]))
    rig = kitti_rig()
    pair = simulate_pair(motion, rig, key=jax.random.key(1), noise=0.0, outlier_fraction=0.3)
    assert pair.previous.dtype == jnp.float64
    matrix = np.asarray(motion.matrix())
    moved = numpy_points(rig, np.asarray(pair.current)) @ matrix[:3, :3].T + matrix[:3, 3]
    error = np.abs(numpy_measurements(rig, moved) - np.asarray(pair.previous)).max(axis=1)
    inlier = np.asarray(pair.is_inlier)
    assert error[inlier].max() < 1e-9 and np.median(error[~inlier]) > 20.0
    depth = numpy_points(rig, np.asarray(pair.current))[:, 2]
    assert depth.min() > 3.99 and depth.max() < 60.01
    assert np.asarray(pair.current)[:, 0].max() < 1241 and np.asarray(pair.current)[:, 2].max() < 376


def test_noise_and_outliers_are_as_frequent_as_asked(dtype):
    drive = simulate_stereo_points(key=jax.random.key(0), num_frames=60)
    exact = simulate_stereo_points(key=jax.random.key(0), num_frames=60, noise=0.0)
    assert drive.pairs.previous.dtype == dtype and drive.pairs.previous.shape == (59, 300, 3)
    assert float(jnp.mean(drive.pairs.is_inlier)) == pytest.approx(0.75, abs=0.01)
    for name in ("previous", "current"):
        noise = np.asarray(getattr(drive.pairs, name) - getattr(exact.pairs, name))
        np.testing.assert_allclose(noise.std(axis=(0, 1)), 0.5, atol=0.01)
        np.testing.assert_allclose(noise.mean(axis=(0, 1)), 0.0, atol=0.02)


def test_the_drive_is_that_of_a_car():
    path = simulate_drive(600, key=jax.random.key(3))
    np.testing.assert_array_equal(path.matrices()[0], np.eye(4))
    steps = np.linalg.norm(np.diff(path.positions, axis=0), axis=1)
    assert 0.75 < steps.min() and steps.max() < 1.25
    assert 540 < float(path.length()) < 660
    yaw = jax.jit(lambda path: jax.vmap(lambda motion: motion.log())(path.relative()))(path)[:, 4]
    assert 0.005 < float(jnp.std(yaw)) < 0.05
    assert float(jnp.max(jnp.abs(jnp.diff(yaw)))) < 0.01  # smooth
    other = simulate_drive(600, key=jax.random.key(4))
    assert not np.allclose(path.positions, other.positions)


def test_motions_of_pairs_are_those_of_the_path():
    drive = simulate_stereo_points(key=jax.random.key(5), num_frames=10, num_points=5)
    matrices = np.asarray(drive.truth.matrices(), dtype=np.float64)
    expected = np.linalg.inv(matrices[:-1]) @ matrices[1:]
    actual = jax.vmap(lambda motion: motion.matrix())(drive.pairs.motion)
    np.testing.assert_allclose(actual, expected, atol=1e-5)
    with pytest.raises(TypeError, match="The rig came in float32"), jax.enable_x64(True):
        rig = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), kitti_rig())
        simulate_stereo_points(key=jax.random.key(5), rig=rig, num_frames=3)
