"""The whole odometry, on the synthetic street and on KITTI clips: T-68...T-71, K-86, K-87."""

import dataclasses

import numpy as np
import pytest

from jaxloc.data import kitti, simulate_street
from jaxloc.odometry import MatchingOptions
from jaxloc.pipelines import odometry

pytestmark = pytest.mark.heavy


def matrices(steps):
    return np.stack([np.asarray(step.pose.matrix(), np.float64) for step in steps])


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


def test_street_is_followed_within_a_millimeter_a_meter(street):
    sequence, truth = street
    steps = list(odometry.steps(sequence, sequence.rig))
    assert all(step.ok for step in steps)
    assert drift_percent(matrices(steps), truth) < 0.3
    assert steps[0].num_matches == 0 and not steps[0].covariance.any()
    traces = [np.trace(step.covariance) for step in steps]
    assert (np.diff(traces) > 0).all()


def test_keyframes_that_live_longer_give_the_same_path(street):
    sequence, truth = street
    config = odometry.Config(keyframe_frames=3)
    steps = list(odometry.steps(sequence, sequence.rig, config))
    assert all(step.ok for step in steps)
    assert drift_percent(matrices(steps), truth) < 0.3
    motions = np.stack([np.asarray(step.relative.matrix(), np.float64) for step in steps[1:]])
    assert np.allclose(motions, relative(matrices(steps)), atol=1e-4)


def test_dark_frames_are_predicted_with_grown_covariance_and_then_bridged(street):
    sequence, truth = street
    frames = [sequence[i] for i in range(len(sequence))]
    for i in (5, 6):
        frames[i] = dataclasses.replace(
            frames[i], left=np.zeros_like(frames[i].left), right=np.zeros_like(frames[i].right)
        )
    steps = list(odometry.steps(frames, sequence.rig))
    assert [step.ok for step in steps] == [i not in (5, 6) for i in range(len(steps))]
    assert np.trace(steps[5].covariance) > 100 * np.trace(steps[4].covariance)
    assert np.trace(steps[7].covariance) < 0.1 * np.trace(steps[6].covariance)
    assert drift_percent(matrices(steps), truth) < 1.0
    assert all(np.isfinite(step.covariance).all() for step in steps)


def test_a_recording_that_stays_dark_still_gives_poses(street):
    sequence, _ = street
    frame = sequence[0]
    dark = [dataclasses.replace(frame, left=np.zeros_like(frame.left), right=np.zeros_like(frame.right))] * 3
    steps = list(odometry.steps(dark, sequence.rig))
    assert [step.ok for step in steps] == [True, False, False]
    assert np.isfinite(matrices(steps)).all()
    with pytest.raises(ValueError, match="No motion"):
        odometry.calibrate_disparity(dark, sequence.rig)


def test_disparity_is_found_to_be_calibrated_on_the_street(street):
    sequence, _ = street
    offset = odometry.calibrate_disparity([sequence[i] for i in range(8)], sequence.rig)
    assert abs(float(offset.mean[0])) < 0.1


@pytest.mark.recordings
def test_kitti_06_drifts_less_than_one_percent(recordings):
    sequence = kitti.read_sequence(recordings / "kitti_odometry/sequences/06", None)
    truth = np.asarray(sequence.truth.matrices(), np.float64)
    steps = list(odometry.steps(sequence, sequence.rig))
    errors = [
        angle_deg((np.linalg.inv(a) @ b)[:3, :3])
        for a, b in zip(relative(truth), relative(matrices(steps)), strict=True)
    ]
    assert all(step.ok for step in steps)
    assert drift_percent(matrices(steps), truth) < 1.0
    assert np.median(errors) < 0.035


@pytest.mark.recordings
def test_kitti_01_among_moving_cars(recordings):
    """Rotation as good as its own truth; the clip's disparities are too small, which calibration notices and mends."""
    sequence = kitti.read_sequence(recordings / "kitti_odometry/sequences/01", None)
    truth = np.asarray(sequence.truth.matrices(), np.float64)
    steps = list(odometry.steps(sequence, sequence.rig))
    errors = [
        angle_deg((np.linalg.inv(a) @ b)[:3, :3])
        for a, b in zip(relative(truth), relative(matrices(steps)), strict=True)
    ]
    assert np.median(errors) < 0.041
    offset = float(odometry.calibrate_disparity([sequence[i] for i in range(12)], sequence.rig).mean[0])
    assert 0.4 < offset < 1.25
    mended = list(
        odometry.steps(sequence, sequence.rig, odometry.Config(matching=MatchingOptions(disparity_offset=offset)))
    )
    assert drift_percent(matrices(mended), truth) < 0.5 * drift_percent(matrices(steps), truth)
