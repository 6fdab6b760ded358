"""Tracks of moving objects on the rendered street and on a real clip."""

import csv

import jax
import numpy as np
import pytest

from jaxloc.data import kitti, simulate_street
from jaxloc.pipelines import moving_objects

pytestmark = pytest.mark.heavy
CONFIG = moving_objects.Config()


def inside(box, uv, room=6.0):
    left, top, right, bottom = box
    return left - room < uv[0] < right + room and top - room < uv[1] < bottom + room


# T-4, T-68, T-78: a car that comes towards the camera
@pytest.mark.slow
def test_an_oncoming_car_is_tracked_where_it_is():
    street = simulate_street(num_frames=22, seed=0)
    car = street.objects[1]
    found = {}
    for out in moving_objects.run(iter(street), CONFIG, street.rig):
        assert np.isfinite(out.count) and all(np.isfinite(track.state).all() for track in out.tracks)
        for track in out.tracks:
            assert np.all(np.linalg.eigvalsh(track.covariance) > 0)
            apart = np.linalg.inv(car.poses[out.index]) @ np.r_[track.state[:3], 1.0]
            if abs(apart[0]) < 2.0 and abs(apart[2]) < 5.0:
                found[out.index] = track
    assert len(found) >= 3
    assert len({track.label for track in found.values()}) == 1
    index, last = list(found.items())[-1]
    truth = (car.poses[index][:3, 3] - car.poses[index - 1][:3, 3]) / 0.1
    assert np.linalg.norm(last.state[3:] - truth) < 5.0


@pytest.mark.slow
@pytest.mark.recordings
def test_cars_of_a_real_highway(recordings):
    """The lead car in the labeled frames but the first, where nothing has moved yet, and two oncoming cars."""
    folder = recordings / "kitti_odometry"
    with (folder / "moving_cars_01.csv").open() as file:
        labels = [row for row in csv.DictReader(file) if int(row["frame"]) < 11]
    sequence = kitti.read_sequence(folder / "sequences" / "01")
    frames = [sequence[i] for i in range(11)]
    tracks = {out.index: out.tracks for out in moving_objects.run(frames, CONFIG, sequence.rig)}
    hits = {row["track"]: set() for row in labels}
    speeds = []
    for row in labels:
        frame, box = int(row["frame"]), tuple(float(row[name]) for name in ("x1", "y1", "x2", "y2"))
        inner = [track for track in tracks[frame] if inside(box, track.uv)]
        hits[row["track"]] |= {frame} if inner else set()
        speeds += [float(np.linalg.norm(t.state[3:])) for t in inner if row["track"] == "lead"]
    assert hits["lead"] == {4, 8} and all(20.0 < speed < 30.0 for speed in speeds)
    assert sum(bool(frames) for frames in hits.values()) >= 3


@pytest.mark.slow
def test_given_poses_and_dark_frames():
    street = simulate_street(num_frames=6, seed=0)
    frames = [street[i] for i in range(6)]
    dark = frames[3]
    frames[3] = type(dark)(dark.time, np.zeros_like(dark.left), np.zeros_like(dark.right))
    for poses in (None, street.truth.poses):
        outs = list(moving_objects.run(frames, CONFIG, street.rig, poses=poses))
        assert [out.index for out in outs] == list(range(6))
        assert all(np.isfinite(out.count) for out in outs)
        if poses is not None:
            for out, pose in zip(outs, np.asarray(jax.vmap(lambda p: p.matrix())(poses)), strict=True):
                np.testing.assert_allclose(out.odometry.pose.matrix(), pose, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("known", [False, True])
def test_a_restored_run_gives_the_same_numbers(check_resumed, known):
    street = simulate_street(num_frames=6, seed=0)
    poses = [jax.tree.map(lambda leaf, i=i: leaf[i], street.truth.poses) for i in range(6)]
    frames = [(street[i], poses[i] if known else None) for i in range(6)]

    def step(state, frame):
        return moving_objects.step(state, frame[0], pose=frame[1])

    check_resumed(lambda: moving_objects.init(CONFIG, street.rig), step, frames, 3)
