"""``jaxloc track`` on a rendered street, from files to files."""

import csv
import json

import cv2
import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from jaxloc.cli.app import app
from jaxloc.data import kitti, simulate_street

pytestmark = pytest.mark.heavy
FRAMES = 18


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    folder = tmp_path_factory.mktemp("street")
    street = simulate_street(num_frames=FRAMES, seed=0)
    for name in ("image_0", "image_1"):
        (folder / name).mkdir()
    for i, frame in enumerate(street):
        cv2.imwrite(str(folder / "image_0" / f"{i:06d}.png"), frame.left)
        cv2.imwrite(str(folder / "image_1" / f"{i:06d}.png"), frame.right)
    camera = street.rig.camera
    left = [[float(camera.fx), 0, float(camera.cx), 0], [0, float(camera.fy), float(camera.cy), 0], [0, 0, 1, 0]]
    right = np.array(left)
    right[0, 3] = -float(camera.fx) * float(street.rig.baseline)
    rows = [" ".join(f"{x:.9e}" for x in np.ravel(matrix)) for matrix in (left, right)]
    (folder / "calib.txt").write_text(f"P0: {rows[0]}\nP1: {rows[1]}\n")
    (folder / "times.txt").write_text("\n".join(f"{t:.6f}" for t in street.times) + "\n")
    kitti.write_poses(folder / "poses.txt", street.truth)
    return folder


def run(*arguments):
    return CliRunner().invoke(app, [str(a) for a in arguments])


@pytest.mark.slow
def test_rows_images_and_report(recording, tmp_path):
    out = tmp_path / "out"
    result = run("track", recording, "--poses", recording / "poses.txt", "--out", out)
    assert result.exit_code == 0, result.output
    with (out / "tracks.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == "frame,id,x,y,z,vx,vy,vz,var_x,var_y,var_z,u,v".split(",")
    assert all(np.isfinite([float(x) for x in row.values()]).all() for row in rows)
    assert len({(row["frame"], row["id"]) for row in rows}) == len(rows)
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["frames"] == FRAMES and metrics["track_frames"] == len(rows)
    assert {"detect", "flow", "group", "filter"} <= set(metrics["stages_ms"])
    assert len(list((out / "images").glob("*.png"))) == 8
    assert yaml.safe_load((out / "config.yaml").read_text())["command"] == "track"
    assert "Seen from above" in (out / "report.html").read_text()
    assert len((out / "trajectory.txt").read_text().splitlines()) == FRAMES

    place = np.array([448262.25, 5411932.5, 300.0])
    poses = np.loadtxt(recording / "poses.txt").reshape(-1, 3, 4)
    poses[:, :, 3] += place
    np.savetxt(tmp_path / "far.txt", poses.reshape(-1, 12), fmt="%.9f")
    result = run("track", recording, "--poses", tmp_path / "far.txt", "--out", tmp_path / "far")
    assert result.exit_code == 0, result.output
    given = np.loadtxt(tmp_path / "far" / "trajectory.txt")[:, [3, 7, 11]]
    np.testing.assert_allclose(given, poses[:, :, 3], atol=1e-3)
    with (tmp_path / "far" / "tracks.csv").open() as file:
        far = list(csv.DictReader(file))
    assert [(row["frame"], row["id"]) for row in far] == [(row["frame"], row["id"]) for row in rows]
    for name, shift in zip("xyz", place, strict=True):
        there, here = (np.array([float(row[name]) for row in table]) for table in (far, rows))
        np.testing.assert_allclose(there - shift, here, atol=0.05)


def test_bad_input_is_one_line(tmp_path):
    from jaxloc.cli import run as run_command

    code = run_command(["track", str(tmp_path / "nothing"), "--out", str(tmp_path / "out")])
    assert code == 2
    assert not (tmp_path / "out").exists()
