"""Mosaics from simulated drives: errors against exact truth, loops closed, bad images left out and named."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.data.simulate import floor
from jaxloc.pipelines import floor_mosaic
from jaxloc.pipelines.floor_mosaic.mosaic import Config
from jaxloc.poses.planar import compose_poses, relative_poses

SHAPE, HEIGHT, PIXEL = (160, 208), 0.045, 0.045 / (700.0 * 208 / 640)
FRAMES = 24


@pytest.fixture(scope="module")
def drive():
    """A loop of small images with a distorting lens."""
    camera = floor.make_camera(SHAPE, height=HEIGHT)
    return floor.drive_loop(3, num_frames=FRAMES, step=0.008, camera=camera, sigmas=(1.5e-4, 1.5e-4, 4e-3))


@pytest.fixture(scope="module")
def built(drive):
    return floor_mosaic.make_mosaic(
        drive.frames, drive.odometry, drive.camera.ground, covariances=drive.covariances, start=drive.poses[0]
    )


def test_frame_errors_and_loop_closure(drive, built):
    assert built.ok and built.left_out == () and any(pair.ok and pair.closes for pair in built.pairs)
    for pair in built.pairs:
        if pair.ok and not pair.closes:
            truth = relative_poses(drive.poses[pair.first][None], drive.poses[pair.second][None])
            error = relative_poses(truth, pair.motion[None])[0]
            assert np.hypot(error[0], error[1]) / PIXEL < 0.1
    length = np.linalg.norm(np.diff(drive.poses[:, :2], axis=0), axis=1).sum()
    before = relative_poses(drive.poses, built.before_closure)[-1]
    assert np.hypot(before[0], before[1]) < 0.002 * length
    after = relative_poses(drive.poses, built.poses)
    assert np.hypot(after[:, 0], after[:, 1]).max() / PIXEL < 1.0
    reckoned = relative_poses(drive.poses, drive.reckoned())[-1]
    assert np.hypot(reckoned[0], reckoned[1]) > 10 * np.hypot(after[-1, 0], after[-1, 1])


def test_the_mosaic_is_the_floor(drive, built):
    """Gray levels against the texture at the same places, gain and bias aside: no exposure steps."""
    mosaic, texture = built.mosaic, drive.floor
    x, y = (np.asarray(axis, np.float64) for axis in mosaic.raster.centers())
    u, v = (x - texture.origin[0]) / texture.resolution, (y - texture.origin[1]) / texture.resolution
    known = np.asarray(mosaic.weight) > 0.2
    rows, columns = np.rint(v[known]).astype(int), np.rint(u[known]).astype(int)
    truth, values = texture.texture[rows, columns], np.asarray(mosaic.values)[known]
    fit = np.polyfit(truth, values, 1)
    assert np.corrcoef(truth, values)[0, 1] > 0.97
    left = np.zeros(mosaic.values.shape)
    left[known] = values - np.polyval(fit, truth)
    blocks = [
        left[a : a + 16, b : b + 16][known[a : a + 16, b : b + 16]].mean()
        for a in range(0, left.shape[0] - 16, 16)
        for b in range(0, left.shape[1] - 16, 16)
        if known[a : a + 16, b : b + 16].all()
    ]
    assert np.std(blocks) < 1.5
    gains = np.log(built.gains) - np.log(drive.gains)
    assert np.std(gains) < 0.03


def test_tracking_on_a_second_drive(drive, built):
    rng = np.random.default_rng(4)
    photographer = floor.Photographer(drive.floor, drive.camera)
    truth = compose_poses(drive.poses[:8], rng.normal(size=(8, 3)) * np.array([1e-3, 1e-3, 0.1]))
    frames = [photographer.take(pose, gain=1.1, rng=rng) for pose in truth]
    odometry = compose_poses(
        relative_poses(truth[:-1], truth[1:]), rng.normal(size=(7, 3)) * np.array([2e-4, 2e-4, 4e-3])
    )
    frames[4] = np.full_like(frames[4], 80)
    start = compose_poses(truth[:1], np.array([[5e-4, -5e-4, 0.01]]))[0]
    found = list(floor_mosaic.localize(built, frames, odometry, start))
    assert [step.ok for step in found] == [True] * 4 + [False] + [True] * 3
    errors = relative_poses(truth, np.stack([step.pose for step in found]))
    distance = np.hypot(errors[:, 0], errors[:, 1])
    assert distance[[0, 1, 2, 3, 5, 6, 7]].max() < 0.2 * PIXEL and distance[4] < 1e-3
    assert np.trace(found[4].covariance) > 10 * np.trace(found[3].covariance)


def test_bad_pictures_are_left_out_and_named(drive):
    """A blank image, one of another place, one with nan pixels (which is used)."""
    frames = drive.frames[:8].astype(np.float32)
    frames[2] = 90.0
    frames[5] = floor.Photographer(floor.make_floor(99, low=(0.0, 0.0), high=(0.1, 0.1)), drive.camera).take(
        np.array([0.05, 0.05, 0.0])
    )
    frames[6, 20:60, 30:90] = np.nan
    frames[6, :, 100] = np.nan
    built = floor_mosaic.make_mosaic(
        frames, drive.odometry[:7], drive.camera.ground, covariances=drive.covariances[:7], start=drive.poses[0]
    )
    assert built.left_out == (2, 5)
    errors = relative_poses(drive.poses[:8], built.poses)
    distance = np.hypot(errors[:, 0], errors[:, 1]) / PIXEL
    assert distance[[0, 1, 3, 4, 6, 7]].max() < 1.0 and distance.max() < 20.0
    assert np.isfinite(np.asarray(built.mosaic.values)).all()
    assert built.covariances[2, 0, 0] > 100 * built.covariances[3, 0, 0]


def test_a_far_picture_has_no_overlap(drive):
    odometry = drive.odometry[:3].copy()
    odometry[2, 0] = 5.0
    built = floor_mosaic.make_mosaic(drive.frames[:4], odometry, drive.camera.ground, covariances=drive.covariances[:3])
    assert built.left_out == (3,)
    np.testing.assert_allclose(built.poses[0], 0.0)


def test_wrong_input_is_refused(drive):
    ground = drive.camera.ground
    with pytest.raises(ValueError, match="two or more gray images"):
        floor_mosaic.make_mosaic(drive.frames[:1], np.zeros((0, 3)), ground)
    with pytest.raises(ValueError, match="need 2 motions"):
        floor_mosaic.make_mosaic(drive.frames[:3], np.zeros((3, 3)), ground)
    with pytest.raises(ValueError, match="not finite"):
        floor_mosaic.make_mosaic(drive.frames[:2], np.full((1, 3), np.nan), ground)
    with pytest.raises(ValueError, match="neighbors is 0"):
        Config(neighbors=0)
    with pytest.raises(ValueError, match="min_overlap"):
        dataclasses.replace(Config(), min_overlap=1.5)
    assert isinstance(jnp.asarray(drive.frames), jnp.ndarray)
