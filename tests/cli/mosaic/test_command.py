"""``jaxloc mosaic``: files, numbers, errors."""

import json
import re

import cv2
import numpy as np
import pytest
import yaml

from jaxloc.cli import run
from jaxloc.data import tum
from jaxloc.data.camera_file import CameraFile, write_camera
from jaxloc.data.simulate import floor
from jaxloc.poses.planar import relative_poses

FILES = ["config.yaml", "metrics.json", "mosaic.png", "mosaic.yaml", "report.html", "trajectory.tum"]
SHAPE, HEIGHT, FRAMES = (120, 160), 0.035, 6


@pytest.fixture(scope="module")
def drive():
    camera = floor.make_camera(SHAPE, height=HEIGHT)
    return floor.drive_loop(5, num_frames=40, step=0.004, camera=camera, sigmas=(2e-4, 2e-4, 4e-3))


@pytest.fixture(scope="module")
def inputs(drive, tmp_path_factory):
    """Six images, of which the fourth is blank; odometry; the camera."""
    folder = tmp_path_factory.mktemp("inputs")
    (folder / "frames").mkdir()
    rows = []
    for number, (x, y, heading) in enumerate(drive.reckoned()[:FRAMES]):
        image = np.full(SHAPE, 70, np.uint8) if number == 3 else drive.frames[number]
        cv2.imwrite(str(folder / "frames" / f"floor{number:03d}.png"), image)
        matrix = np.eye(4)
        matrix[:2, :2] = [[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]]
        matrix[:2, 3] = x, y
        rows.append(tum.format_pose(50.0 + 0.1 * number, matrix))
    (folder / "odometry.tum").write_text("\n".join(rows) + "\n")
    write_camera(folder / "camera.yaml", CameraFile(drive.camera.ground.camera, shape=SHAPE, height=HEIGHT))
    return folder


def arguments(inputs, out, **other):
    named = {"frames": inputs / "frames", "odometry": inputs / "odometry.tum", "camera": inputs / "camera.yaml"} | other
    words = ["mosaic", named["frames"], "--odometry", named["odometry"], "--camera", named["camera"], "--out", out]
    return [str(word) for word in words]


@pytest.mark.slow
def test_every_file_is_written(drive, inputs, tmp_path, capsys):
    out = tmp_path / "out"
    assert run(arguments(inputs, out)) == 0
    assert sorted(path.name for path in out.iterdir()) == FILES
    printed = capsys.readouterr().out
    assert "5 of 6 images joined" in printed and "left out: floor003.png" in printed

    stamped = tum.read_trajectory(out / "trajectory.tum")
    assert stamped.start == 50.0 and len(stamped.trajectory) == FRAMES
    matrices = np.asarray(stamped.trajectory.matrices(), np.float64)
    rows = np.column_stack([matrices[:, :2, 3], np.arctan2(matrices[:, 1, 0], matrices[:, 0, 0])])
    used = [0, 1, 2, 4, 5]
    errors = relative_poses(drive.poses[used], rows[used])
    assert np.hypot(errors[:, 0], errors[:, 1]).max() < 2e-4

    place = yaml.safe_load((out / "mosaic.yaml").read_text())
    image = cv2.imread(str(out / place["image"]), cv2.IMREAD_GRAYSCALE)
    # The place under the first camera: from the lower left corner, rows counted from the top.
    x, y = (drive.poses[1, :2] - np.array(place["origin"][:2])) / place["resolution"]
    u, v = round(x - 0.5), round(image.shape[0] - y - 0.5)
    texture, low = drive.floor.texture, np.array(drive.floor.origin)
    column, row = np.rint((drive.poses[1, :2] - low) / drive.floor.resolution).astype(int)
    patch = image[v - 20 : v + 21, u - 20 : u + 21].astype(float)[::-1]
    truth = texture[row - 20 : row + 21, column - 20 : column + 21]
    assert np.corrcoef(patch.ravel(), truth.ravel())[0, 1] > 0.9

    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["left_out"] == ["floor003.png"] and metrics["images_used"] == 5 and metrics["graph_solved"]
    page = (out / "report.html").read_text()
    for title in ("Mosaic", "Residuals", "Uncertainty", "Left out", "Numbers"):
        assert f"<h2>{title}</h2>" in page
    assert "floor003.png" in page and "http://" not in page
    config = yaml.safe_load((out / "config.yaml").read_text())
    assert config["command"] == "mosaic" and config["config"]["neighbors"] == 2


def test_bad_input_is_one_line_and_writes_nothing(inputs, tmp_path, capsys, drive):
    out = tmp_path / "out"

    def refuse(match, *extra, **other):
        assert run([*arguments(inputs, out, **other), *map(str, extra)]) == 2
        error = capsys.readouterr().err
        assert error.startswith("jaxloc: error: ") and error.count("\n") == 1
        assert re.search(match, error), error
        assert not out.exists()

    refuse(r"nowhere: no such folder", frames=tmp_path / "nowhere")
    refuse(r"holds 0 images", frames=tmp_path)
    refuse(r"no.tum", odometry=tmp_path / "no.tum")
    short = tmp_path / "short.tum"
    short.write_text("1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 1\n")
    refuse(r"short.tum: has 2 poses for 6 images", odometry=short)
    low = tmp_path / "low.yaml"
    write_camera(low, CameraFile(drive.camera.ground.camera, shape=SHAPE))
    refuse(r"height_m", camera=low)
    write_camera(low, CameraFile(drive.camera.ground.camera, shape=(100, 100), height=HEIGHT))
    refuse(r"floor000.png: has 160 x 120 pixels, must have 100 x 100", camera=low)
    options = tmp_path / "bad.yaml"
    options.write_text("neighbors: 0\n")
    refuse(r"bad.yaml: neighbors is 0, must be at least 1", "--config", options)
    broken = tmp_path / "frames"
    broken.mkdir()
    for name in ("a.png", "b.png"):
        (broken / name).write_bytes(b"no image")
    refuse(r"a.png: is no image", frames=broken, odometry=short)
