"""``jaxloc localize``: files, numbers, errors."""

import json

import equinox as eqx
import numpy as np
import pytest
import yaml

from jaxloc.cli import run
from jaxloc.cli.localize.report import Reference
from jaxloc.data import ros_map, simulate_laser_drive, tum
from jaxloc.poses.planar import compose_poses, planar_matrix

FILES = ["config.yaml", "metrics.json", "report.html", "spread.csv", "trajectory.tum"]
SCANS = 30


@pytest.fixture(scope="module")
def drive():
    return simulate_laser_drive(seed=3, num_beams=60)


@pytest.fixture(scope="module")
def inputs(drive, tmp_path_factory):
    """A folder with a map, a log, the true poses and options of a small run."""
    folder = tmp_path_factory.mktemp("inputs")
    ros_map.write_map(folder / "map.yaml", drive.building.map())
    lines = []
    for time, ranges, (x, y, heading) in zip(drive.log.times, drive.log.ranges, drive.log.odometry, strict=True):
        laser = x + 0.1 * np.cos(heading), y + 0.1 * np.sin(heading), heading
        numbers = [*ranges.tolist(), *laser, x, y, heading, 100.0 + time]
        lines.append(" ".join(["FLASER", str(len(ranges)), *(f"{number:.6f}" for number in numbers), "host", "0"]))
    (folder / "drive.log").write_text("\n".join(lines[:SCANS]) + "\n")
    rows = []
    for time, (x, y, heading) in zip(drive.log.times, drive.truth, strict=True):
        matrix = np.eye(4)
        matrix[:2, :2] = [[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]]
        matrix[:2, 3] = x, y
        rows.append(tum.format_pose(100.0 + time, matrix))
    (folder / "truth.tum").write_text("\n".join(rows[::2]) + "\n")
    (folder / "options.yaml").write_text("num_particles: 600\nnum_particles_global: 600\n")
    return folder


@pytest.mark.slow
def test_every_file_is_written(drive, inputs, tmp_path, capsys):
    out = tmp_path / "out"
    start = [f"{value:.4f}" for value in drive.truth[0]]
    options = ["--reference", inputs / "truth.tum", "--config", inputs / "options.yaml", "--out", out]
    arguments = ["localize", inputs / "drive.log", "--map", inputs / "map.yaml", "--start", *start, *options]
    assert run([str(argument) for argument in arguments]) == 0
    assert sorted(path.name for path in out.iterdir()) == FILES
    assert str(out / "report.html") in capsys.readouterr().out

    stamped = tum.read_trajectory(out / "trajectory.tum")
    assert stamped.start == 100.0 and len(stamped.trajectory) == SCANS
    positions = np.asarray(stamped.trajectory.positions)
    np.testing.assert_allclose(positions[:, :2], drive.truth[:SCANS, :2], atol=0.3)
    np.testing.assert_allclose(positions[:, 2], 0.0)
    spread = (out / "spread.csv").read_text().splitlines()
    assert spread[0].startswith("time,sigma_x,sigma_y,sigma_heading,mass") and len(spread) == SCANS + 1
    assert all(np.isfinite([float(word) for word in line.split(",")]).all() for line in spread[1:])

    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["scans"] == SCANS and metrics["found_at_end"] and metrics["scans_compared"] == SCANS // 2
    assert metrics["error_median_m"] < 0.1 and metrics["error_median_deg"] < 1.0
    page = (out / "report.html").read_text()
    for title in ("Path", "Particles", "Error", "Effective sample size", "Confidence", "Numbers"):
        assert f"<h2>{title}</h2>" in page
    assert page.count("data:image/") == 5 and "http://" not in page
    config = yaml.safe_load((out / "config.yaml").read_text())
    assert config["command"] == "localize" and config["config"]["num_particles"] == 600
    assert config["config"]["odometry"]["slip"] == 0.1


def test_odometry_is_no_reference(drive):
    times, odometry = drive.log.times[:SCANS], drive.log.odometry[:SCANS]
    log = eqx.tree_at(lambda log: (log.times, log.odometry), drive.log, (times, odometry))
    assert Reference(times, odometry.round(3)).is_odometry(log)
    assert Reference(times, compose_poses(np.array([[3.0, -1.0, 2.0]] * SCANS), odometry)).is_odometry(log)
    assert not Reference(times, drive.truth[:SCANS]).is_odometry(log)
    assert not Reference(times, odometry + np.linspace(0.0, 0.02, SCANS)[:, None]).is_odometry(log)
    still = eqx.tree_at(lambda log: log.odometry, log, 0.0 * odometry)
    assert not Reference(times, still.odometry).is_odometry(still)


@pytest.mark.slow
def test_a_map_in_a_national_grid(drive, inputs, tmp_path):
    """Coordinates that single precision cannot hold: the path is that of a map near zero, moved."""
    place = [448262.35, 5411932.65]
    text = (inputs / "map.yaml").read_text()
    x, y, heading = yaml.safe_load(text)["origin"]
    far = {**yaml.safe_load(text), "origin": [x + place[0], y + place[1], heading], "image": str(inputs / "map.pgm")}
    (tmp_path / "far.yaml").write_text(yaml.safe_dump(far))
    rows = np.loadtxt(inputs / "truth.tum")
    rows[:, 1:3] += place
    np.savetxt(tmp_path / "truth.tum", rows, fmt="%.9f")
    start = [f"{value:.4f}" for value in drive.truth[0] + np.array([*place, 0.0])]
    options = ["--reference", tmp_path / "truth.tum", "--config", inputs / "options.yaml", "--out", tmp_path / "out"]
    command = ["localize", inputs / "drive.log", "--map", tmp_path / "far.yaml", "--start", *start, *options]
    assert run([str(a) for a in command]) == 0
    path = np.loadtxt(tmp_path / "out" / "trajectory.tum")
    np.testing.assert_allclose(path[:, 1:3] - np.array(place), drive.truth[:SCANS, :2], atol=0.3)
    assert json.loads((tmp_path / "out" / "metrics.json").read_text())["error_median_m"] < 0.1
    page = (tmp_path / "out" / "report.html").read_text()
    assert "Figures count from x 448000 m, y 5412000 m of the map." in page


def test_a_global_start_without_a_reference(inputs, tmp_path):
    out = tmp_path / "out"
    options = ["--config", inputs / "options.yaml", "--out", out]
    assert run([str(a) for a in ("localize", inputs / "drive.log", "--map", inputs / "map.yaml", *options)]) == 0
    metrics = json.loads((out / "metrics.json").read_text())
    assert "error_median_m" not in metrics and metrics["scans"] == SCANS
    assert "<h2>Error</h2>" not in (out / "report.html").read_text()


def test_bad_input_is_one_line_and_writes_nothing(drive, inputs, tmp_path, refused):
    out = tmp_path / "out"
    log, grid = inputs / "drive.log", inputs / "map.yaml"

    def refuse(match, *, log=log, grid=grid, extra=()):
        refused(["localize", log, "--map", grid, "--out", out, *extra], match)
        assert not out.exists()

    silent = tmp_path / "silent.log"
    silent.write_text("ODOM 0 0 0 0 0 0 1 host 1\n")
    refuse(r"silent.log: has no laser lines", log=silent)
    refuse(r"no.log: no such file", log=tmp_path / "no.log")
    backwards = tmp_path / "backwards.log"
    backwards.write_text("\n".join(reversed(log.read_text().splitlines())))
    refuse(r"backwards.log: time goes backwards", log=backwards)
    lone = tmp_path / "lone.yaml"
    lone.write_text(grid.read_text().replace("map.pgm", "missing.pgm"))
    refuse(r"missing.pgm: no such image", grid=lone)
    lone.write_text(grid.read_text().replace("resolution: 0.05", "resolution: 0"))
    (tmp_path / "map.pgm").write_bytes((inputs / "map.pgm").read_bytes())
    refuse(r"lone.yaml: resolution is 0, must be positive", grid=lone)
    lone.write_text(grid.read_text())
    pixels = (inputs / "map.pgm").read_bytes()
    (tmp_path / "map.pgm").write_bytes(pixels.replace(b"\x00", b"\xfe"))
    refuse(r"lone.yaml: shows no obstacle", grid=lone)
    (tmp_path / "map.pgm").write_bytes(pixels.replace(b"\xfe", b"\xcd"))
    refuse(r"lone.yaml: shows no free cell", grid=lone)
    refuse(r"(?i)--start", extra=["--start", "1", "2"])
    refuse(r"(?i)three finite numbers", extra=["--start", "1", "2", "nan"])
    other = tmp_path / "other.tum"
    other.write_text("1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 1\n")
    refuse(r"other.tum: has no pose at the time of any scan", extra=["--reference", other])
    rows = []
    for number, pose in enumerate(compose_poses(np.array([[3.0, -1.0, 2.0]] * SCANS), drive.log.odometry[:SCANS])):
        rows.append(tum.format_pose(100.0 + drive.log.times[number], planar_matrix(pose)))
    other.write_text("\n".join(rows) + "\n")
    refuse(r"other.tum: holds the odometry of the log, which is no reference", extra=["--reference", other])
    options = tmp_path / "bad.yaml"
    options.write_text("num_particles: 0\n")
    refuse(r"bad.yaml: num_particles is 0, must be at least 1", extra=["--config", options])
    refused(["localize", log], "(?i)missing option")
