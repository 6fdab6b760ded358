"""The command line with a stand-in for the pipeline: files, errors, interrupts."""

import builtins
import json
import os
import re
import signal
import subprocess
import sys
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import yaml

from jaxloc.cli import run
from jaxloc.data import covariance, kitti, tum
from jaxloc.poses import SE3

FILES = ["config.yaml", "covariance.csv", "metrics.json", "report.html", "trajectory.tum", "trajectory.txt"]


class Kernel(eqx.Module):
    scale: float = 1.5


class Config(eqx.Module):
    num_features: int = 300
    threshold: float = 2.0
    kernel: Kernel = Kernel()


class Step(eqx.Module):
    time: float
    pose: SE3
    covariance: np.ndarray
    relative: SE3
    relative_covariance: np.ndarray
    ok: bool
    num_inliers: int
    num_matches: int
    timings: dict[str, float]
    uv_previous: np.ndarray
    uv_current: np.ndarray
    inlier: np.ndarray


class Pipeline:
    """Dead reckoning at a meter a frame, whatever the images show."""

    Config = Config

    def __init__(self):
        self.used = None
        self.interrupt_at = None
        self.fail_at = None

    def steps(self, frames: Any, rig: Any, config: Config) -> Iterator[Step]:
        self.used = config
        pose = SE3.identity()
        for index, frame in enumerate(frames):
            if index == self.fail_at:
                raise RuntimeError("broken")
            if index == self.interrupt_at:
                os.kill(os.getpid(), signal.SIGINT)
            motion = SE3.exp(jnp.array([0.0, 0.0, 1.0 if index else 0.0, 0.0, 0.0, 0.0]))
            pose = pose @ motion
            count = 8 if index else 0
            places = np.arange(2.0 * count).reshape(count, 2)
            spread = 1e-4 * np.eye(6)
            yield Step(
                time=frame.time,
                pose=pose,
                covariance=index * spread,
                relative=motion,
                relative_covariance=spread,
                ok=True,
                num_inliers=count,
                num_matches=count,
                timings={"match": 0.01},
                uv_previous=places,
                uv_current=places + 1.0,
                inlier=np.ones(count, bool),
            )


class Objects:
    """Finds nothing that moves."""

    class Config(eqx.Module):
        odometry: Any = Config()

    def __init__(self, odometry: Pipeline):
        self.odometry = odometry

    def steps(self, frames: Any, rig: Any, config: Any, *, poses: Any = None) -> Iterator[Any]:
        del poses
        none = {"points": np.zeros((0, 2)), "objects": np.zeros((0, 6)), "boxes": np.zeros((0, 4)), "tracks": ()}
        for index, step in enumerate(self.odometry.steps(frames, rig, config.odometry)):
            yield types.SimpleNamespace(index=index, odometry=step, timings={"filter": 0.01}, count=0.0, **none)


@pytest.fixture
def pipeline(monkeypatch):
    stand_in = Pipeline()
    module = types.ModuleType("jaxloc.pipelines")
    module.odometry, module.datmo = stand_in, Objects(stand_in)
    monkeypatch.setitem(sys.modules, "jaxloc.pipelines", module)
    return stand_in


@pytest.fixture
def sequence(tmp_path, rng):
    folder = tmp_path / "sequences" / "03"
    for name in ("image_0", "image_1"):
        (folder / name).mkdir(parents=True)
        for index in range(6):
            image = rng.integers(0, 256, (30, 50), dtype=np.uint8)
            cv2.imwrite(str(folder / name / f"{index:06d}.png"), image)
    (folder / "calib.txt").write_text("P0: 70 0 25 0 0 70 15 0 0 0 1 0\nP1: 70 0 25 -35 0 70 15 0 0 0 1 0\n")
    (folder / "times.txt").write_text("".join(f"{0.1 * index}\n" for index in range(6)))
    poses = tmp_path / "poses" / "03.txt"
    poses.parent.mkdir()
    # The truth starts elsewhere: only motions are compared. A fiftieth of the way is missing in the estimate.
    poses.write_text("".join(f"1 0 0 5 0 1 0 6 0 0 1 {7 + 1.02 * index}\n" for index in range(6)))
    return folder


def refused(capsys, arguments, match):
    """The command ends with exit code 2 and one line that says why."""
    assert run([str(argument) for argument in arguments]) == 2
    error = capsys.readouterr().err
    assert error.startswith("jaxloc: error: ") and error.count("\n") == 1
    assert re.search(match, error), error


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
    covariances = covariance.read_covariances(out / "covariance.csv")
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


def test_options_come_from_a_file_or_from_an_earlier_run(pipeline, sequence, tmp_path):
    options = tmp_path / "mine.yaml"
    options.write_text("threshold: 3\nkernel:\n  scale: 0.5\n")
    out = tmp_path / "out"
    assert run(["odometry", str(sequence), "--out", str(out), "--config", str(options)]) == 0
    assert pipeline.used == Config(threshold=3.0, kernel=Kernel(0.5))
    pipeline.used = None
    assert run(["demo", "--frames", "6", "--out", str(tmp_path / "demo"), "--config", str(out / "config.yaml")]) == 0
    assert pipeline.used == Config(threshold=3.0, kernel=Kernel(0.5))


@pytest.mark.parametrize(
    "text, match",
    [
        ("nothing: 1", r"mine.yaml: no option nothing; there are num_features, threshold, kernel"),
        ("kernel: {width: 1}", r"no option kernel.width; there are scale"),
        ("threshold: many", r"threshold is 'many', must be like 2.0"),
        ("threshold: .nan", r"threshold is nan, must be finite"),
        ("num_features: 1.5", r"num_features is 1.5, must be like 300"),
        ("kernel: 3", r"kernel must be a mapping"),
        ("- 1", r"the file must be a mapping"),
        ("a: [", r"no valid YAML"),
    ],
)
def test_bad_options_are_refused(pipeline, sequence, tmp_path, capsys, text, match):
    options = tmp_path / "mine.yaml"
    options.write_text(text)
    out = tmp_path / "out"
    refused(capsys, ["odometry", sequence, "--config", options, "--out", out], match)
    assert not out.exists() and pipeline.used is None


def test_the_demo_reports_on_a_synthetic_street(pipeline, tmp_path):
    out = tmp_path / "demo"
    assert run(["demo", "--frames", "6", "--seed", "3", "--out", str(out)]) == 0
    assert sorted(path.name for path in out.iterdir()) == sorted([*FILES, "moving_objects"])
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["frames"] == 6 and metrics["end_drift_percent"] < 5.0
    objects = json.loads((out / "moving_objects" / "metrics.json").read_text())
    assert objects["frames"] == 6 and objects["tracks"] == 0
    assert yaml.safe_load((out / "config.yaml").read_text())["seed"] == 3


def test_an_interrupt_keeps_what_was_done(pipeline, sequence, tmp_path):
    pipeline.interrupt_at = 3
    out = tmp_path / "out"
    assert run(["odometry", str(sequence), "--out", str(out)]) == 130
    assert sorted(path.name for path in out.iterdir()) == FILES
    # The frame in which Ctrl-C came is finished.
    assert len(kitti.read_poses(out / "trajectory.txt")) == 4
    assert len(tum.read_trajectory(out / "trajectory.tum").trajectory) == 4
    assert covariance.read_covariances(out / "covariance.csv").shape == (4, 6, 6)
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["frames"] == 4 and metrics["interrupted"] is True
    assert "Interrupted" in (out / "report.html").read_text()
    # Ctrl-C means what it meant before.
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


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
def test_bad_recordings_are_refused_before_anything_is_written(pipeline, sequence, tmp_path, capsys, spoil, match):
    spoil(sequence)
    out = tmp_path / "out"
    refused(capsys, ["odometry", sequence, "--out", out], match)
    assert not out.exists() and pipeline.used is None


def test_bad_arguments_are_refused(pipeline, sequence, tmp_path, capsys):
    refused(capsys, ["odometry", tmp_path / "nowhere"], "nowhere: no such folder")
    refused(capsys, ["odometry"], "(?i)missing argument")
    refused(capsys, ["odometry", sequence, "--wrong"], "(?i)no such option")
    refused(capsys, ["demo", "--frames", "one"], "(?i)invalid value")
    refused(capsys, ["nothing"], "(?i)no such command")
    refused(capsys, ["odometry", sequence, "--poses", tmp_path / "no.txt"], "no.txt: no such file")
    refused(
        capsys, ["odometry", sequence, "--config", tmp_path / "no.yaml", "--out", tmp_path / "o"], "no.yaml: no such"
    )
    file = tmp_path / "file"
    file.write_text("")
    refused(capsys, ["odometry", sequence, "--out", file], "file: is a file, but the results need a folder")
    refused(capsys, ["odometry", sequence, "--out", file / "deeper"], "file: is a file")


def test_help_and_version(capsys):
    import jaxloc

    assert run(["--version"]) == 0
    assert capsys.readouterr().out.strip() == f"jaxloc {jaxloc.__version__}"
    assert run([]) == 0
    text = capsys.readouterr().out
    assert "odometry" in text and "demo" in text
    assert run(["odometry", "--help"]) == 0


@pytest.mark.parametrize("module", ["typer", "matplotlib", "jinja2", "yaml"])
def test_missing_extras_are_explained(pipeline, sequence, tmp_path, capsys, monkeypatch, module):
    original = builtins.__import__

    def refuse(name, *args, **kwargs):
        if name.split(".")[0] == module:
            raise ImportError(name, name=module)
        return original(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", refuse)
    for name in [name for name in sys.modules if name.startswith("jaxloc.cli.")]:
        monkeypatch.delitem(sys.modules, name)
    out = tmp_path / "out"
    refused(capsys, ["odometry", sequence, "--out", out], r'pip install "jaxloc\[cli\]"')
    assert not out.exists()


def test_help_as_a_module_imports_nothing_heavy():
    code = (
        "import sys; from jaxloc.cli import run; assert run(['--help']) == 0; "
        "assert not {'jax', 'numpy', 'cv2', 'matplotlib'} & set(sys.modules), sorted(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, timeout=60)
    done = subprocess.run([sys.executable, "-m", "jaxloc", "--version"], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0 and done.stdout.startswith("jaxloc ")


def test_compilations_are_kept_in_the_users_cache_folder(monkeypatch, tmp_path):
    import jax

    from jaxloc.cli import session

    kept = jax.config.jax_compilation_cache_dir, jax.config.jax_persistent_cache_min_compile_time_secs
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(sys, "platform", "linux")
    try:
        jax.config.update("jax_compilation_cache_dir", None)
        session.keep_compilations()
        assert Path(jax.config.jax_compilation_cache_dir) == tmp_path / "jaxloc" / "compiled"
        jax.config.update("jax_compilation_cache_dir", "elsewhere")
        session.keep_compilations()
        assert jax.config.jax_compilation_cache_dir == "elsewhere"
    finally:
        jax.config.update("jax_compilation_cache_dir", kept[0])
        jax.config.update("jax_persistent_cache_min_compile_time_secs", kept[1])
