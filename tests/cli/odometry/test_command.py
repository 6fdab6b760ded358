"""``jaxloc odometry`` and ``jaxloc demo`` with a stand-in for the pipelines: files, refused recordings."""

import json

import cv2
import numpy as np
import pytest
import yaml

from jaxloc.cli import run
from jaxloc.data import covariance_csv, kitti, tum

FILES = ["config.yaml", "covariance.csv", "metrics.json", "report.html", "trajectory.tum", "trajectory.txt"]


def test_odometry_writes_every_file(pipeline, sequence, tmp_path, capsys):
    out = tmp_path / "deep" / "out"
    assert run(["odometry", str(sequence), "--out", str(out)]) == 0
    assert sorted(path.name for path in out.iterdir()) == FILES
    assert str(out / "report.html") in capsys.readouterr().out

    path = kitti.read_poses(out / "trajectory.txt")
    np.testing.assert_allclose(path.positions, [[0, 0, z] for z in range(6)], atol=1e-6)
    stamped = tum.read_trajectory(out / "trajectory.tum", start=0.0).trajectory
    np.testing.assert_allclose(stamped.times, 0.1 * np.arange(6), atol=1e-6)
    np.testing.assert_allclose(stamped.positions, path.positions, atol=1e-6)
    covariances = covariance_csv.read_covariances(out / "covariance.csv")
    np.testing.assert_allclose(covariances, 1e-4 * np.arange(6)[:, None, None] * np.eye(6))

    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["frames"] == 6 and metrics["interrupted"] is False and metrics["median_matches"] == 8.0
    assert metrics["distance_m"] == pytest.approx(5.0)
    assert metrics["end_drift_percent"] == pytest.approx(100 * 0.02 / 1.02, rel=1e-3)
    assert metrics["t_err_percent"] > 0 and metrics["r_err_deg_per_m"] == pytest.approx(0.0, abs=1e-5)
    assert metrics["ate_rmse_m"] == pytest.approx(np.sqrt(np.mean((0.02 * np.arange(6)) ** 2)), rel=1e-3)
    # Each motion is wrong by 2 sigmas in one of six directions.
    assert metrics["motion_nees_mean"] == pytest.approx(4.0, rel=1e-3)
    assert metrics["motion_coverage"] == {"0.5": 1.0, "0.9": 1.0, "0.95": 1.0}

    page = (out / "report.html").read_text()
    for title in ("Trajectory", "Matches", "Drift", "Uncertainty", "Timings", "Numbers"):
        assert f"<h2>{title}</h2>" in page
    assert page.count("data:image/") == 5 and "http://" not in page

    config = yaml.safe_load((out / "config.yaml").read_text())
    assert config["command"] == "odometry" and config["sequence"] == str(sequence)
    assert config["config"] == {"num_features": 300, "threshold": 2.0, "kernel": {"scale": 1.5}}


@pytest.mark.slow
def test_the_demo_reports_on_a_synthetic_street(pipeline, tmp_path):
    out = tmp_path / "demo"
    assert run(["demo", "--frames", "6", "--seed", "3", "--out", str(out)]) == 0
    assert sorted(path.name for path in out.iterdir()) == sorted([*FILES, "moving_objects"])
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["frames"] == 6 and metrics["end_drift_percent"] < 5.0
    objects = json.loads((out / "moving_objects" / "metrics.json").read_text())
    assert objects["frames"] == 6 and objects["tracks"] == 0
    assert yaml.safe_load((out / "config.yaml").read_text())["seed"] == 3


def break_calibration(folder):
    (folder / "calib.txt").write_text("P0: 70 0 25 0 0 70 15 0 0 0 1 0\n")


def break_size(folder):
    cv2.imwrite(str(folder / "image_1" / "000002.png"), np.zeros((30, 51), np.uint8))


def truncate_image(folder):
    path = folder / "image_0" / "000004.png"
    path.write_bytes(path.read_bytes()[:500])


def damage_image(folder):
    path = folder / "image_1" / "000004.png"
    data = bytearray(path.read_bytes())
    data[300] ^= 1
    path.write_bytes(bytes(data))


def empty_sequence(folder):
    for path in (folder / "image_0").iterdir():
        path.unlink()


@pytest.mark.parametrize(
    "spoil, match",
    [
        (break_calibration, r"calib.txt: has no line P1:"),
        (break_size, r"000002.png: is 51x30 px, but 000000.png is 50x30 px"),
        (truncate_image, r"000004.png: truncated PNG image"),
        (damage_image, r"image_1.000004.png: damaged PNG image"),
        (empty_sequence, r"image_0: empty sequence"),
        (lambda folder: (folder / "image_1" / "000001.png").unlink(), r"image_1.000001.png: no such image"),
        (lambda folder: (folder / "times.txt").write_text("0\n1\n"), r"times.txt: has 2 times for 6 images"),
        (lambda folder: (folder / "times.txt").unlink(), r"times.txt: no such file"),
    ],
)
def test_bad_recordings_are_refused_before_anything_is_written(pipeline, sequence, tmp_path, refused, spoil, match):
    spoil(sequence)
    out = tmp_path / "out"
    refused(["odometry", sequence, "--out", out], match)
    assert not out.exists() and pipeline.used is None
