"""``jaxloc lane``: files, numbers, errors."""

import json
import re

import cv2
import numpy as np
import pytest
import yaml

import jaxloc as jl
from jaxloc.cli import run
from jaxloc.data.camera_file import CameraFile, write_camera
from jaxloc.data.simulate.road.drive import Course, drive
from jaxloc.data.simulate.road.rendering import Road

SHAPE = (240, 320)
FILES = ["borders.csv", "config.yaml", "lane.csv", "metrics.json", "report.html"]
FRAMES = 8


@pytest.fixture(scope="module")
def trip():
    ground = jl.sensors.GroundCamera(jl.sensors.Pinhole(250.0, 250.0, 159.5, 100.0), 1.3, 0.03)
    return drive(Road(), ground, FRAMES, course=Course(interval=0.1), shape=SHAPE)


@pytest.fixture(scope="module")
def inputs(trip, tmp_path_factory):
    """A video, a folder of images, and cameras with and without a pitch and a height."""
    folder = tmp_path_factory.mktemp("inputs")
    (folder / "images").mkdir()
    video = cv2.VideoWriter(str(folder / "road.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 10.0, SHAPE[::-1])
    for index, frame in enumerate(trip.frames()):
        color = cv2.cvtColor(np.rint(frame).astype(np.uint8), cv2.COLOR_GRAY2BGR)
        video.write(color)
        if index < 2:
            cv2.imwrite(str(folder / "images" / f"{index}.png"), color)
    video.release()
    cv2.imwrite(str(folder / "images" / "2.png"), np.zeros((*SHAPE, 3), np.uint8))
    camera = jl.sensors.Pinhole(250.0, 250.0, 159.5, 100.0)
    write_camera(folder / "camera.yaml", CameraFile(camera, SHAPE, height=1.3, pitch=0.03))
    write_camera(folder / "no_pitch.yaml", CameraFile(camera, SHAPE, height=1.3))
    write_camera(folder / "no_height.yaml", CameraFile(camera, SHAPE, pitch=0.03))
    return folder


def read(path):
    """Header and numbers of a table."""
    header, *rows = path.read_text().splitlines()
    return header, np.array([[float(word) for word in row.split(",")] for row in rows])


@pytest.mark.slow
def test_a_video(trip, inputs, tmp_path, capsys):
    out = tmp_path / "out"
    arguments = [
        "lane",
        inputs / "road.avi",
        "--camera",
        inputs / "camera.yaml",
        "--speed",
        "21",
        "--set",
        "speed=5",
        "--out",
        out,
    ]
    assert run([str(argument) for argument in arguments]) == 0
    assert sorted(path.name for path in out.iterdir()) == sorted([*FILES, "annotated.mp4"])
    assert str(out / "report.html") in capsys.readouterr().out

    header, lanes = read(out / "lane.csv")
    assert header == "frame,offset,heading,curvature,confidence,ok"
    assert lanes.shape == (FRAMES, 6) and (lanes[:, 5] == 1.0).all() and (lanes[:, 4] > 0.3).all()
    np.testing.assert_array_equal(lanes[:, 0], np.arange(FRAMES))
    assert np.median(np.abs(lanes[:, 1] - trip.lanes[:, 0])) < 0.03
    header, borders = read(out / "borders.csv")
    assert header == "frame,row,left,right" and len(borders) == 16 * FRAMES
    assert (borders[:, 2] < borders[:, 3]).all() and set(borders[:, 0]) == set(range(FRAMES))

    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["frames"] == metrics["frames_ok"] == FRAMES and not metrics["pitch_estimated"]
    assert metrics["pitch_rad"] == pytest.approx(0.03) and metrics["sources"]["borders"] == FRAMES - 1
    video = cv2.VideoCapture(str(out / "annotated.mp4"))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == FRAMES
    video.release()
    page = (out / "report.html").read_text()
    for title in ("Images", "Offset", "Heading", "Curvature", "Confidence", "Numbers"):
        assert f"<h2>{title}</h2>" in page
    assert "http://" not in page
    config = yaml.safe_load((out / "config.yaml").read_text())
    assert config["command"] == "lane" and config["config"]["speed"] == 21.0


def test_images_and_an_unknown_pitch(inputs, tmp_path):
    out = tmp_path / "out"
    options = tmp_path / "options.yaml"
    options.write_text("lane_width: 3.5\nmotion:\n  pitch: 0.005\n")
    arguments = ["lane", inputs / "images", "--camera", inputs / "no_pitch.yaml", "--config", options, "--out", out]
    assert run([str(argument) for argument in arguments]) == 0
    assert sorted(path.name for path in out.iterdir()) == sorted([*FILES, "images"])
    assert sorted(path.name for path in (out / "images").iterdir()) == ["0.jpg", "1.jpg", "2.jpg"]
    _, lanes = read(out / "lane.csv")
    assert lanes[:, 5].tolist() == [1.0, 1.0, 0.0] and lanes[2, 4] == 0.0, "a dark image shows no lane"
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["pitch_estimated"] and abs(metrics["pitch_rad"] - 0.03) < 0.01 and metrics["not_ok"] == ["2.png"]
    page = (out / "report.html").read_text()
    assert "estimated from the vanishing point" in page and "<h2>Not measured</h2>" in page


def test_bad_input_is_one_line_and_writes_nothing(inputs, tmp_path, capsys):
    out = tmp_path / "out"

    def refuse(match, *, path=inputs / "road.avi", camera=inputs / "camera.yaml", extra=()):
        assert run([str(a) for a in ("lane", path, "--camera", camera, "--out", out, *extra)]) == 2
        error = capsys.readouterr().err
        assert error.startswith("jaxloc: error: ") and error.count("\n") == 1
        assert re.search(match, error), error
        assert not out.exists()

    refuse("no_height.yaml: has no height_m", camera=inputs / "no_height.yaml")
    refuse("nothing.avi: no such file", path=inputs / "nothing.avi")
    torn = tmp_path / "torn.mp4"
    torn.write_bytes(b"\x00\x00\x00\x18ftypmp42" + bytes(500))
    refuse("torn.mp4: is no video that can be decoded", path=torn)
    empty = tmp_path / "empty"
    empty.mkdir()
    refuse("empty: has no images", path=empty)
    small = tmp_path / "small.png"
    cv2.imwrite(str(small), np.zeros((24, 32), np.uint8))
    refuse(r"camera.yaml: is of images of 320x240, but those of .*small.png are 32x24", path=small)
    wrong = tmp_path / "up.yaml"
    write_camera(wrong, CameraFile(jl.sensors.Pinhole(250.0, 250.0, 159.5, 100.0), SHAPE, height=1.3, pitch=-0.6))
    refuse("up.yaml: .*check its pitch and height", camera=wrong)
    options = tmp_path / "bad.yaml"
    options.write_text("blend: 2.0\n")
    refuse("bad.yaml: blend is 2.0, must lie between 0 and 1", extra=["--config", options])
    refuse("(?i)--speed", extra=["--speed", "-3"])
