"""Runs that are interrupted or fail."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time

import pytest

from jaxloc.cli import run
from jaxloc.data import covariance_csv, kitti, tum

FILES = ["config.yaml", "covariance.csv", "metrics.json", "report.html", "trajectory.tum", "trajectory.txt"]


@pytest.mark.parametrize("number, code", [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interrupt_keeps_what_was_done(pipeline, sequence, tmp_path, number, code):
    pipeline.interrupt_at, pipeline.signal = 3, number
    out, handler = tmp_path / "out", signal.getsignal(number)
    assert run(["odometry", str(sequence), "--out", str(out)]) == code
    assert sorted(path.name for path in out.iterdir()) == FILES
    # The frame in which Ctrl-C came is finished.
    assert len(kitti.read_poses(out / "trajectory.txt")) == 4
    assert len(tum.read_trajectory(out / "trajectory.tum").trajectory) == 4
    assert covariance_csv.read_covariances(out / "covariance.csv").shape == (4, 6, 6)
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["frames"] == 4 and metrics["interrupted"] is True
    assert "Interrupted" in (out / "report.html").read_text()
    assert signal.getsignal(number) is handler


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


def test_a_second_interrupt_stops_at_once(pipeline, sequence, tmp_path, monkeypatch):
    once = pipeline.output

    def twice(index, frame):
        if index == 2:
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGTERM)
        return once(index, frame)

    monkeypatch.setattr(pipeline, "output", twice)
    out = tmp_path / "out"
    assert run(["odometry", str(sequence), "--out", str(out)]) == 143
    assert sorted(path.name for path in out.iterdir()) == ["covariance.csv", "trajectory.tum", "trajectory.txt"]
    assert len(kitti.read_poses(out / "trajectory.txt")) == 2


def start(*arguments):
    code = "import sys, jaxloc.cli; sys.argv[0] = 'jaxloc'; jaxloc.cli.main()"
    return subprocess.Popen([sys.executable, "-c", code, *map(str, arguments)], stderr=subprocess.PIPE, text=True)


def test_an_interrupt_while_starting_is_one_line(sequence, tmp_path):
    process = start("odometry", sequence, "--out", tmp_path / "out")
    time.sleep(0.7)  # in the middle of the imports
    process.send_signal(signal.SIGTERM)
    error = process.communicate(timeout=60)[1]
    assert process.returncode in (143, -signal.SIGTERM) and "Traceback" not in error
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
@pytest.mark.parametrize("number, code", [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interrupted_process_leaves_whole_files(tmp_path, number, code):
    process = start("demo", "--frames", 200, "--out", tmp_path)

    def rows():
        return [path for path in tmp_path.rglob(".trajectory.txt.*") if len(path.read_text().splitlines()) > 2]

    for _ in range(600):
        if rows():
            break
        time.sleep(0.2)
    process.send_signal(number)
    error = process.communicate(timeout=120)[1]
    assert process.returncode == code and "Traceback" not in error
    assert not list(tmp_path.rglob("*.partial"))
    (path,) = tmp_path.rglob("trajectory.txt")
    assert 2 < len(kitti.read_poses(path)) < 200


@pytest.mark.skipif(sys.platform == "win32", reason="no limits of processes")
def test_a_full_disk_is_one_line(pipeline, sequence, tmp_path, refused):
    import resource

    out = tmp_path / "out"
    assert run(["odometry", str(sequence), "--out", str(out)]) == 0
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        for size in (10, 600, 3000):
            resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
            refused(["odometry", sequence, "--out", out], "cannot be written: File too large")
            assert not list(out.glob(".*"))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert before.keys() == {path.name for path in out.iterdir()}


@pytest.mark.parametrize("name", ["a b", "<b>", "$\\frac$", "two\nlines", b"\xff"])
def test_names_of_files_are_text_only(pipeline, sequence, tmp_path, capsys, name):
    folder = tmp_path / (os.fsdecode(name) if isinstance(name, bytes) else name)
    shutil.copytree(sequence, folder)
    assert run(["odometry", str(folder), "--out", str(tmp_path / "out")]) == 0
    report = (tmp_path / "out" / "report.html").read_bytes().decode()
    body = report.split("<body", 1)[1]
    assert "<b>" not in body and ("&lt;b&gt;" in body) == (name == "<b>")
    assert run(["odometry", str(folder / "missing"), "--out", str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err.count("\n") == 1


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
