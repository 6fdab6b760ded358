"""``jaxloc calibrate``: files, numbers, errors."""

import json
import re

import cv2
import numpy as np
import pytest

from jaxloc.cli import run
from jaxloc.data.camera_file import read_camera

FILES = ["camera.yaml", "config.yaml", "corners.csv", "metrics.json", "report.html"]
GRID, SHAPE = (6, 5), (240, 320)
MATRIX = np.array([[300.0, 0.0, 160.0], [0.0, 300.0, 118.0], [0.0, 0.0, 1.0]])


def render(rotation, center):
    """A board of 7x6 squares of 0.1 m by a camera without lens."""
    turned = cv2.Rodrigues(np.array(rotation, float))[0]
    shift = np.array(center, float) - turned @ [0.25, 0.2, 0.0]
    homography = MATRIX @ np.column_stack([turned[:, :2], shift])
    fine = np.indices((SHAPE[0] * 4, SHAPE[1] * 4))[::-1]
    u, v = (fine + 0.5) / 4 - 0.5
    x, y, w = np.einsum("ij,jhw->ihw", np.linalg.inv(homography), np.stack([u, v, np.ones_like(u)]))
    x, y = x / w / 0.1 + 1.0, y / w / 0.1 + 1.0
    inside = (x > 0) & (x < GRID[0] + 1) & (y > 0) & (y < GRID[1] + 1)
    dark = inside & ((np.floor(x) + np.floor(y)) % 2 == 0)
    image = np.where(dark, 30.0, 220.0).reshape(SHAPE[0], 4, SHAPE[1], 4).mean(axis=(1, 3))
    return cv2.GaussianBlur(image, (0, 0), 0.7).round().astype(np.uint8)


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """Folders of the left and the right camera: six pairs, one image without a board, one of another size."""
    folder = tmp_path_factory.mktemp("inputs")
    rng = np.random.default_rng(2)
    for name in ("left", "right"):
        (folder / name).mkdir()
    for number in range(1, 7):
        rotation, center = rng.uniform(-0.45, 0.45, 3), np.array([*rng.uniform(-0.08, 0.08, 2), 0.95])
        for name, shift in (("left", 0.0), ("right", 0.1)):
            image = render(rotation, center - [shift, 0.0, 0.0])
            cv2.imwrite(str(folder / name / f"view{number}.png"), image)
    for name in ("left", "right"):
        cv2.imwrite(str(folder / name / "view10.png"), np.full(SHAPE, 128, np.uint8))
        cv2.imwrite(str(folder / name / "view11.png"), np.full((100, 100), 128, np.uint8))
    (folder / "options.yaml").write_text("radial: 0\ntangential: false\n")
    return folder


def command(inputs, out, *extra):
    options = ["--grid", "6x5", "--square", "0.1", "--config", inputs / "options.yaml", "--out", out]
    return [str(word) for word in ("calibrate", inputs / "left", *options, *extra)]


def test_one_camera(inputs, tmp_path, capsys):
    out = tmp_path / "out"
    assert run(command(inputs, out)) == 0
    assert sorted(path.name for path in out.iterdir()) == FILES
    said = capsys.readouterr()
    assert "view10.png: shows no whole board" in said.err and "view11.png: is 100x100, the others are" in said.err
    read = read_camera(out / "camera.yaml")
    assert read.shape == SHAPE and 0.0 < read.sigmas()["fx"] < 3.0
    assert abs(float(read.camera.fx) - 300.0) < max(4.0 * read.sigmas()["fx"], 0.5)
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["boards_used"] == 6 and len(metrics["skipped"]) == 2 and metrics["rms_px"] < 0.2
    page = (out / "report.html").read_text()
    for title in ("Parameters", "Residuals", "Boards", "Numbers"):
        assert f"<h2>{title}</h2>" in page
    rows = (out / "corners.csv").read_text().splitlines()
    assert len(rows) == 1 + 6 * 30 and rows[1].startswith("left,view1.png,0,")


@pytest.mark.slow
def test_two_cameras(inputs, tmp_path):
    out = tmp_path / "out"
    assert run(command(inputs, out, "--right", inputs / "right")) == 0
    assert sorted(path.name for path in out.iterdir()) == sorted([*FILES, "right.yaml", "stereo.yaml"])
    storage = cv2.FileStorage(str(out / "stereo.yaml"), cv2.FILE_STORAGE_READ)
    k1, d1, k2, d2, r, t, r1, r2, p2, q = (
        storage.getNode(key).mat() for key in ("M1", "D1", "M2", "D2", "R", "T", "R1", "R2", "P2", "Q")
    )
    assert storage.getNode("parameter_covariance").mat().shape == (26, 26)
    storage.release()
    np.testing.assert_allclose(t.ravel(), [-0.1, 0.0, 0.0], atol=2e-3)
    theirs = cv2.stereoRectify(k1, d1, k2, d2, SHAPE[::-1], r, t)
    np.testing.assert_allclose(r1, theirs[0], atol=1e-9)
    np.testing.assert_allclose(r2, theirs[1], atol=1e-9)
    assert p2[0, 3] / p2[0, 0] == pytest.approx(t[0, 0], abs=1e-3)
    depth = q @ [p2[0, 2] + 5.0, 100.0, -p2[0, 3] / 2.0, 1.0]
    assert depth[2] / depth[3] == pytest.approx(2.0)


def test_bad_input_is_one_line_and_writes_nothing(inputs, tmp_path, capsys):
    out = tmp_path / "out"

    def refuse(match, images, *extra):
        words = ["calibrate", *images, "--grid", "6x5", "--square", "0.1", "--out", out, *extra]
        assert run([str(word) for word in words]) == 2
        error = capsys.readouterr().err
        assert error.startswith("jaxloc: error: ") and error.count("\n") == 1 and not out.exists()
        assert re.search(match, error), error

    left, empty = inputs / "left", tmp_path / "empty"
    empty.mkdir()
    refuse("no.png: no such file", [tmp_path / "no.png"])
    refuse("empty: holds no image", [empty])
    refuse("--grid: is '9', must be like 9x6", [left], "--grid", "9")
    refuse("--grid: is 2x5, must have 3 corners", [left], "--grid", "2x5")
    refuse("--square: is -1, must be positive", [left], "--square", "-1")
    refuse("--square: is nan, must be positive", [left], "--square", "nan")
    rubbish = tmp_path / "rubbish.png"
    rubbish.write_bytes(b"no image")
    refuse("rubbish.png: cannot be read as an image", [rubbish])
    refuse("view10.png: shows no whole board", [left / "view10.png"])
    refuse("--right: has 1 images, the left camera 8", [left], "--right", left / "view1.png")
    options = tmp_path / "bad.yaml"
    options.write_text("radial: 5\n")
    refuse("bad.yaml: BrownConradyModel got radial=5", [left], "--config", options)
    refuse("no calibration", [left / "view1.png"])


def test_mixed_orientations_are_named(inputs, tmp_path, capsys):
    """A lens belongs to the sensor: images that are turned in different ways are of no one camera."""
    exif = b"Exif\0\0MM\0*\0\0\0\x08\0\1\1\x12\0\3\0\0\0\1\0\3\0\0\0\0\0\0"
    for number in (1, 2):
        image = cv2.imread(str(inputs / "left" / f"view{number}.png"), cv2.IMREAD_GRAYSCALE)
        data = cv2.imencode(".jpg", image)[1].tobytes()
        tag = b"\xff\xe1\0" + bytes([len(exif) + 2]) + exif if number == 2 else b""
        (tmp_path / f"{number}.jpg").write_bytes(data[:2] + tag + data[2:])
    words = ["calibrate", tmp_path, "--grid", "6x5", "--square", "0.1", "--out", tmp_path / "out"]
    assert run([str(word) for word in words]) == 2
    error = capsys.readouterr().err
    assert "2.jpg: has the EXIF orientation 3, but 1.jpg has 1" in error and error.count("\n") == 1
