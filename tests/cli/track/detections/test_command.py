"""``jaxloc track --detections``: files, metrics, errors."""

import json
import re

import numpy as np
import pytest
import yaml

from jaxloc.cli import run
from jaxloc.data.tracking import read_mot_tracks
from jaxloc.data.tracking.tracks_csv import HEADER

FILES = ["config.yaml", "metrics.json", "report.html", "tracks.csv", "tracks_mot.txt"]
FRAMES = 20


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """A car ahead and one that comes towards a camera that drives on, in the files of KITTI; the same as boxes."""
    folder = tmp_path_factory.mktemp("inputs")
    rng = np.random.default_rng(0)
    found, labels, poses, boxes, true_boxes = [], [], [], [], []
    for frame in range(FRAMES):
        camera = 0.5 * frame
        poses.append(f"1 0 0 0 0 1 0 0 0 0 1 {camera}")
        for who, (x, z) in enumerate([(0.0, 15.0 + 0.6 * frame), (-3.0, 40.0 - 0.4 * frame)]):
            place = np.array([x, 1.6, z - camera])
            u, v = 700.0 * place[:2] / place[2] + [600.0, 180.0]
            side = 1000.0 / place[2]
            corners = f"{u - side:.2f},{v - side:.2f},{u + side:.2f},{v:.2f}"
            noisy = ",".join(f"{value:.4f}" for value in place + 0.05 * rng.standard_normal(3))
            found.append(f"{frame},2,{corners},10.5,1.5,1.6,4.0,{noisy},1.57,0.0")
            true = " ".join(f"{value:.4f}" for value in place)
            labels.append(f"{frame} {who} Car 0 0 0.0 {corners.replace(',', ' ')} 1.5 1.6 4.0 {true} 1.57")
            left, top = 100.0 + 200 * who + 2 * frame, 50.0
            boxes.append(f"{frame + 1},-1,{left + rng.normal():.2f},{top},40,100,0.98,-1,-1,-1")
            true_boxes.append(f"{frame + 1},{who + 1},{left},{top},40,100,1,-1,-1,-1")
    matrix = "700 0 600 0 0 700 180 0 0 0 1 0"
    rows = [f"P{number}: {matrix}" for number in range(4)]
    rows += ["R0_rect: 1 0 0 0 1 0 0 0 1", "Tr_velo_to_cam: 1 0 0 0 0 1 0 0 0 0 1 0", "Tr_imu_to_velo: " + matrix]
    files = {
        "cars.txt": found,
        "labels.txt": labels,
        "poses.txt": poses,
        "calib.txt": rows,
        "det.txt": boxes,
        "gt.txt": true_boxes,
    }
    for name, lines in files.items():
        (folder / name).write_text("\n".join(lines) + "\n")
    return folder


def call(*arguments):
    return run(["track", *(str(argument) for argument in arguments)])


def table(path):
    lines = path.read_text().splitlines()
    assert lines[0] == HEADER
    return np.array([[float(word or "nan") for word in line.split(",")] for line in lines[1:]])


@pytest.mark.slow
def test_cars_in_the_world(inputs, tmp_path, capsys):
    out = tmp_path / "out"
    options = ["--poses", inputs / "poses.txt", "--calib", inputs / "calib.txt", "--truth", inputs / "labels.txt"]
    assert call("--detections", inputs / "cars.txt", *options, "--out", out) == 0
    assert sorted(path.name for path in out.iterdir()) == FILES
    assert str(out / "report.html") in capsys.readouterr().out

    rows = table(out / "tracks.csv")
    assert np.isfinite(rows).all() and set(rows[:, 1]) == {1.0, 2.0}
    last = rows[rows[:, 0] == FRAMES - 1]
    ahead, coming = last[np.argsort(-last[:, 2])]
    np.testing.assert_allclose(ahead[2:5], [0.0, 1.6, 26.4], atol=0.15)
    np.testing.assert_allclose([ahead[7], coming[7]], [6.0, -4.0], atol=0.5)
    np.testing.assert_allclose(ahead[11:], [600.0, 180.0 + 700 * 1.6 / 16.9], atol=6.0)
    tracks = read_mot_tracks(out / "tracks_mot.txt")
    assert tracks.detections.frames[-1] == FRAMES and tracks.identities().tolist() == [1, 2]

    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["frames"] == FRAMES and metrics["tracks"] == 2 and metrics["switches"] == 0
    assert metrics["hota"] > 0.85 and metrics["gospa_5m"] < 2.0
    assert metrics["seconds_with_compiling"] > 0.0 and metrics["frames_per_second"] is None
    page = (out / "report.html").read_text()
    for title in ("Tracks", "Number of targets", "Numbers"):
        assert f"<h2>{title}</h2>" in page
    assert page.count("data:image/") == 2 and "http://" not in page
    config = yaml.safe_load((out / "config.yaml").read_text())
    assert (
        config["command"] == "track" and config["form"] == "kitti" and config["config"]["confirmation"]["frames"] == 1
    )


@pytest.mark.slow
def test_poses_in_a_national_grid(inputs, tmp_path):
    """The tracks are those in a frame near the cameras, moved."""
    place = np.array([448262.25, 5411932.5, 300.0])
    rows = np.loadtxt(inputs / "poses.txt").reshape(-1, 3, 4)
    rows[:, :, 3] += place
    np.savetxt(tmp_path / "poses.txt", rows.reshape(-1, 12), fmt="%.6f")
    options = ["--calib", inputs / "calib.txt", "--truth", inputs / "labels.txt"]
    found = []
    for name, poses in (("near", inputs / "poses.txt"), ("far", tmp_path / "poses.txt")):
        assert call("--detections", inputs / "cars.txt", "--poses", poses, *options, "--out", tmp_path / name) == 0
        found.append(table(tmp_path / name / "tracks.csv"))
    near, far = found
    np.testing.assert_allclose(far[:, 2:5] - place, near[:, 2:5], atol=2e-3)
    np.testing.assert_allclose(far[:, 11:], near[:, 11:], atol=0.2)


def test_boxes_in_images(inputs, tmp_path):
    out = tmp_path / "out"
    assert call("--detections", inputs / "det.txt", "--truth", inputs / "gt.txt", "--out", out) == 0
    rows = table(out / "tracks.csv")
    assert np.isnan(rows[:, [4, 7, 10]]).all() and np.isfinite(np.delete(rows, [4, 7, 10], axis=1)).all()
    np.testing.assert_array_equal(rows[:, 2:4], rows[:, 11:])
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["tracks"] == 2 and metrics["hota"] > 0.75 and metrics["idf1"] > 0.9


def test_bad_input_is_one_line_and_writes_nothing(inputs, tmp_path, capsys):
    out = tmp_path / "out"

    def refuse(match, *arguments):
        assert call(*arguments, "--out", out) == 2
        error = capsys.readouterr().err
        assert error.startswith("jaxloc: error: ") and error.count("\n") == 1
        assert re.search(match, error), error
        assert not out.exists()

    cars, bad = inputs / "cars.txt", tmp_path / "bad.txt"
    refuse("either a SEQUENCE or --detections")
    refuse("either a SEQUENCE or --detections", "folder", "--detections", cars)
    refuse("go with --detections", "folder", "--truth", cars)
    refuse("no.txt: no such file", "--detections", tmp_path / "no.txt")
    refuse("--format is 'voc'", "--detections", cars, "--format", "voc")
    refuse("--tracker is 'sort'", "--detections", cars, "--tracker", "sort")
    refuse("cars.txt: line 1 has 15 numbers, needs 7 to 10", "--detections", cars, "--format", "mot")
    refuse("does not apply to boxes", "--detections", inputs / "det.txt", "--poses", inputs / "poses.txt")
    bad.write_text("1,2,3\n")
    refuse("bad.txt: has an unknown format", "--detections", bad)
    bad.write_text("")
    refuse("bad.txt: has an unknown format", "--detections", bad)
    lines = cars.read_text().splitlines()
    bad.write_text("\n".join([*lines[:3], lines[3].replace("10.5", "ten")]))
    refuse("bad.txt: line 4 holds something that is no number", "--detections", bad)
    bad.write_text("\n".join(line.replace("10.5", "nan") for line in lines))
    refuse("bad.txt: holds no detection that can be used", "--detections", bad)
    bad.write_text("1 0 0 0 0 1 0 0 0 0 1 0\n")
    refuse("beyond the last of 1 frames", "--detections", cars, "--poses", bad)
    bad.write_text("1 2 Car\n")
    refuse("bad.txt: line 1 has 3 words, needs 17", "--detections", cars, "--truth", bad)
    refuse("bad.txt: line 1 has 2 numbers, needs 12", "--detections", cars, "--calib", bad)
    bad.write_text("capacity: 0\n")
    refuse("bad.txt: capacity is 0", "--detections", cars, "--config", bad)


@pytest.mark.recordings
def test_a_real_sequence(recordings, tmp_path):
    folder, out = recordings / "kitti_tracking_dev", tmp_path / "out"
    options = ["--poses", folder / "orbslam3_poses/0012.txt", "--truth", folder / "label_02/0012.txt"]
    assert call("--detections", folder / "det_pointrcnn_Car/0012.txt", *options, "--out", out) == 0
    assert json.loads((out / "metrics.json").read_text())["hota"] > 0.6
