"""Stereo odometry on the synthetic street and on KITTI clips: T-68...T-71, K-86, K-87."""

import dataclasses
import types

import numpy as np
import pytest

from jaxloc.data import kitti, simulate_street
from jaxloc.odometry import MatchingOptions
from jaxloc.pipelines import odometry

pytestmark = pytest.mark.heavy


def matrices(outs):
    return np.stack([np.asarray(out.pose.matrix(), np.float64) for out in outs])


def relative(poses):
    return np.linalg.inv(poses[:-1]) @ poses[1:]


def angle_deg(rotation):
    sine = np.linalg.norm(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    return np.degrees(np.arctan2(sine, np.trace(rotation) - 1))


def drift_percent(poses, truth):
    length = np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum()
    return 100 * np.linalg.norm(poses[-1, :3, 3] - truth[-1, :3, 3]) / length


@pytest.fixture(scope="module")
def street():
    sequence = simulate_street(num_frames=12, seed=1)
    return sequence, np.asarray(sequence.truth.matrices(), np.float64)


@pytest.mark.slow
def test_drift_on_the_street_is_below_three_thousandths(street):
    sequence, truth = street
    outs = list(odometry.run(sequence, odometry.Config(), sequence.rig))
    assert all(out.ok for out in outs)
    assert drift_percent(matrices(outs), truth) < 0.3
    assert outs[0].num_matches == 0 and not outs[0].covariance.any()
    traces = [np.trace(out.covariance) for out in outs]
    assert (np.diff(traces) > 0).all()


@pytest.mark.slow
def test_older_keyframes_give_the_same_path(street):
    sequence, truth = street
    config = odometry.Config(keyframe_frames=3)
    outs = list(odometry.run(sequence, config, sequence.rig))
    assert all(out.ok for out in outs)
    assert drift_percent(matrices(outs), truth) < 0.3
    motions = np.stack([np.asarray(out.relative.matrix(), np.float64) for out in outs[1:]])
    assert np.allclose(motions, relative(matrices(outs)), atol=1e-4)


@pytest.mark.slow
def test_dark_frames_are_predicted_with_grown_covariance_and_then_bridged(street):
    sequence, truth = street
    frames = [sequence[i] for i in range(len(sequence))]
    for i in (5, 6):
        frames[i] = dataclasses.replace(
            frames[i], left=np.zeros_like(frames[i].left), right=np.zeros_like(frames[i].right)
        )
    outs = list(odometry.run(frames, odometry.Config(), sequence.rig))
    assert [out.ok for out in outs] == [i not in (5, 6) for i in range(len(outs))]
    assert np.trace(outs[5].covariance) > 100 * np.trace(outs[4].covariance)
    assert np.trace(outs[7].covariance) < 0.1 * np.trace(outs[6].covariance)
    assert drift_percent(matrices(outs), truth) < 1.0
    assert all(np.isfinite(out.covariance).all() for out in outs)


@pytest.mark.slow
def test_a_recording_that_stays_dark_still_gives_poses(street):
    sequence, _ = street
    frame = sequence[0]
    dark = [dataclasses.replace(frame, left=np.zeros_like(frame.left), right=np.zeros_like(frame.right))] * 3
    outs = list(odometry.run(dark, odometry.Config(), sequence.rig))
    assert [out.ok for out in outs] == [True, False, False]
    assert np.isfinite(matrices(outs)).all()
    with pytest.raises(ValueError, match="No motion"):
        odometry.calibrate_disparity(dark, sequence.rig)


@pytest.mark.slow
def test_the_disparity_offset_of_the_street_is_zero(street):
    sequence, _ = street
    offset = odometry.calibrate_disparity([sequence[i] for i in range(8)], sequence.rig)
    assert abs(float(offset.mean[0])) < 0.1


def test_a_restored_run_gives_the_same_numbers(street, check_resumed):
    sequence, _ = street
    frames = [sequence[i] for i in range(6)]
    config = odometry.Config(keyframe_frames=3)
    outs, _ = check_resumed(lambda: odometry.init(config, sequence.rig), odometry.step, frames, 3)
    for one, other in zip(outs, odometry.run(frames, config, sequence.rig), strict=True):
        np.testing.assert_array_equal(one.pose.matrix(), other.pose.matrix())
        np.testing.assert_array_equal(one.covariance, other.covariance)


def test_images_that_cannot_be_used_are_refused(street):
    sequence, _ = street
    frame = sequence[0]
    state = odometry.init(odometry.Config(), sequence.rig)

    def refuse(match, state=state, **images):
        with pytest.raises(ValueError, match=match):
            odometry.step(state, types.SimpleNamespace(**vars(frame) | images))

    refuse("left image has shape .* not a color image", left=np.stack([frame.left] * 3, axis=2))
    refuse("right image is missing", right=None)
    refuse("right image has dtype uint16", right=frame.right.astype(np.uint16))
    refuse("right image has shape", right=frame.right[:, 1:])
    state, _ = odometry.step(state, frame)
    refuse("left image has shape .* start anew with init", state, left=frame.left[1:], right=frame.right[1:])


@pytest.mark.slow
@pytest.mark.recordings
def test_kitti_06_drifts_less_than_one_percent(recordings):
    sequence = kitti.read_sequence(recordings / "kitti_odometry/sequences/06", None)
    truth = np.asarray(sequence.truth.matrices(), np.float64)
    outs = list(odometry.run(sequence, odometry.Config(), sequence.rig))
    errors = [
        angle_deg((np.linalg.inv(a) @ b)[:3, :3])
        for a, b in zip(relative(truth), relative(matrices(outs)), strict=True)
    ]
    assert all(out.ok for out in outs)
    assert drift_percent(matrices(outs), truth) < 1.0
    assert np.median(errors) < 0.035


@pytest.mark.slow
@pytest.mark.recordings
def test_kitti_01_among_moving_cars(recordings):
    """Rotation within the accuracy of the truth; the clip's disparities are too small, which calibration corrects."""
    sequence = kitti.read_sequence(recordings / "kitti_odometry/sequences/01", None)
    truth = np.asarray(sequence.truth.matrices(), np.float64)
    outs = list(odometry.run(sequence, odometry.Config(), sequence.rig))
    errors = [
        angle_deg((np.linalg.inv(a) @ b)[:3, :3])
        for a, b in zip(relative(truth), relative(matrices(outs)), strict=True)
    ]
    assert np.median(errors) < 0.041
    offset = float(odometry.calibrate_disparity([sequence[i] for i in range(12)], sequence.rig).mean[0])
    assert 0.4 < offset < 1.25
    corrected = list(
        odometry.run(sequence, odometry.Config(matching=MatchingOptions(disparity_offset=offset)), sequence.rig)
    )
    assert drift_percent(matrices(corrected), truth) < 0.5 * drift_percent(matrices(outs), truth)
