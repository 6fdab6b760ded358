"""Runs that are interrupted or fail."""

import json
import signal

import pytest

from jaxloc.cli import run
from jaxloc.data import covariance_csv, kitti, tum

FILES = ["config.yaml", "covariance.csv", "metrics.json", "report.html", "trajectory.tum", "trajectory.txt"]


def test_an_interrupt_keeps_what_was_done(pipeline, sequence, tmp_path):
    pipeline.interrupt_at = 3
    out, handler = tmp_path / "out", signal.getsignal(signal.SIGINT)
    assert run(["odometry", str(sequence), "--out", str(out)]) == 130
    assert sorted(path.name for path in out.iterdir()) == FILES
    # The frame in which Ctrl-C came is finished.
    assert len(kitti.read_poses(out / "trajectory.txt")) == 4
    assert len(tum.read_trajectory(out / "trajectory.tum").trajectory) == 4
    assert covariance_csv.read_covariances(out / "covariance.csv").shape == (4, 6, 6)
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["frames"] == 4 and metrics["interrupted"] is True
    assert "Interrupted" in (out / "report.html").read_text()
    assert signal.getsignal(signal.SIGINT) is handler


def test_a_failure_leaves_the_files_of_the_last_run(pipeline, sequence, tmp_path):
    out = tmp_path / "out"
    assert run(["odometry", str(sequence), "--out", str(out)]) == 0
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    pipeline.fail_at = 2
    with pytest.raises(RuntimeError, match="broken"):
        run(["odometry", str(sequence), "--out", str(out)])
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before
    with pytest.raises(RuntimeError, match="broken"):
        run(["odometry", str(sequence), "--out", str(tmp_path / "new" / "folder")])
    assert not (tmp_path / "new").exists()


def test_an_interrupt_before_the_first_output_leaves_nothing(pipeline, sequence, tmp_path, monkeypatch):
    def interrupted(frames, config, rig):
        signal.raise_signal(signal.SIGINT)
        return iter(())

    monkeypatch.setattr(pipeline, "run", interrupted)
    assert run(["odometry", str(sequence), "--out", str(tmp_path / "out")]) == 130
    assert not (tmp_path / "out").exists()


def test_a_pipeline_without_output_is_one_line(pipeline, sequence, tmp_path, monkeypatch, refused):
    monkeypatch.setattr(pipeline, "run", lambda frames, config, rig: iter(()))
    refused(["odometry", sequence, "--out", tmp_path / "out"], "holds nothing to process")
    assert not (tmp_path / "out").exists()
