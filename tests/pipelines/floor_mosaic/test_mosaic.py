"""Mosaics from simulated drives: errors against exact truth, loops closed, bad images left out and named."""

import dataclasses

import numpy as np
import pytest

from jaxloc.data.simulate import floor
from jaxloc.pipelines import floor_mosaic
from jaxloc.pipelines.floor_mosaic import Config
from jaxloc.poses.planar import relative_poses

PIXEL = 0.045 / (700.0 * 208 / 640)  # m


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
def test_bad_images_are_left_out_and_named(drive):
    """A blank image, one of another place, one with nan pixels (which is used)."""
    frames = drive.frames[:8].astype(np.float32)
    frames[2] = 90.0
    frames[5] = floor.Photographer(floor.make_floor(99, low=(0.0, 0.0), high=(0.1, 0.1)), drive.camera).take(
        np.array([0.05, 0.05, 0.0])
    )
    frames[6, 20:60, 30:90] = np.nan
    frames[6, :, 100] = np.nan
    built = floor_mosaic.make_mosaic(
        frames, drive.odometry[:7], drive.camera.ground, covariances=drive.covariances[:7], initial=drive.poses[0]
    )
    assert built.left_out == (2, 5)
    errors = relative_poses(drive.poses[:8], built.poses)
    distance = np.hypot(errors[:, 0], errors[:, 1]) / PIXEL
    assert distance[[0, 1, 3, 4, 6, 7]].max() < 1.0 and distance.max() < 20.0
    assert np.isfinite(np.asarray(built.mosaic.values)).all()
    assert built.covariances[2, 0, 0] > 100 * built.covariances[3, 0, 0]


@pytest.mark.slow
def test_a_far_image_has_no_overlap(drive):
    odometry = drive.odometry[:3].copy()
    odometry[2, 0] = 5.0
    built = floor_mosaic.make_mosaic(drive.frames[:4], odometry, drive.camera.ground, covariances=drive.covariances[:3])
    assert built.left_out == (3,)
    np.testing.assert_allclose(built.poses[0], 0.0)


def test_wrong_input_is_refused(drive):
    ground = drive.camera.ground
    with pytest.raises(ValueError, match="two or more grayscale images"):
        floor_mosaic.make_mosaic(drive.frames[:1], np.zeros((0, 3)), ground)
    with pytest.raises(ValueError, match="need 2 motions"):
        floor_mosaic.make_mosaic(drive.frames[:3], np.zeros((3, 3)), ground)
    with pytest.raises(ValueError, match="not finite"):
        floor_mosaic.make_mosaic(drive.frames[:2], np.full((1, 3), np.nan), ground)
    with pytest.raises(ValueError, match="neighbors is 0"):
        Config(neighbors=0)
    with pytest.raises(ValueError, match="min_overlap"):
        dataclasses.replace(Config(), min_overlap=1.5)


def frames_of(drive, count):
    return list(floor_mosaic.split_frames(drive.frames[:count], drive.odometry, covariances=drive.covariances))


@pytest.mark.slow
def test_a_restored_run_gives_the_same_mosaic(drive, check_resumed):
    view = floor_mosaic.make_view(drive.frames, drive.camera.ground, Config())
    outs, state = check_resumed(lambda: floor_mosaic.init(Config(), view), floor_mosaic.step, frames_of(drive, 6), 3)
    assert [out.ok for out in outs] == [False] + [True] * 5
    built = floor_mosaic.finish(state)
    assert built.ok and built.used.all() and len(built.poses) == 6
    for out, other in zip(outs, floor_mosaic.run(frames_of(drive, 6), Config(), view), strict=True):
        np.testing.assert_array_equal(out.pose, other.pose)


def test_single_images_are_checked(drive):
    state = floor_mosaic.init(Config(), floor_mosaic.make_view(drive.frames, drive.camera.ground, Config()))
    with pytest.raises(ValueError, match="needs two or more images; got 0"):
        floor_mosaic.finish(state)
    first, second, *_ = frames_of(drive, 2)
    with pytest.raises(ValueError, match="uint16"):
        floor_mosaic.step(state, floor_mosaic.Frame(first.image.astype(np.uint16), first.motion))
    state, _ = floor_mosaic.step(state, first)
    with pytest.raises(ValueError, match="start anew"):
        floor_mosaic.step(state, floor_mosaic.Frame(second.image[1:], second.motion))
    with pytest.raises(ValueError, match="odometry of image 1 has non-finite"):
        floor_mosaic.step(state, floor_mosaic.Frame(second.image, np.full(3, np.nan)))
