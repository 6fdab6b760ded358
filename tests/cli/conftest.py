"""A stand-in for the pipelines, a small stereo recording, and refused commands."""

import os
import re
import signal
import sys
import types
from collections.abc import Iterator
from typing import Any

import cv2
import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.cli import run
from jaxloc.poses import SE3


class Kernel(eqx.Module):
    scale: float = 1.5


class Config(eqx.Module):
    num_features: int = 300
    threshold: float = 2.0
    kernel: Kernel = Kernel()


class Output(eqx.Module):
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
        self.signal = signal.SIGINT
        self.fail_at = None

    def run(self, frames: Any, config: Config, rig: Any) -> Iterator[Output]:
        self.used = config
        for index, frame in enumerate(frames):
            if index == self.fail_at:
                raise RuntimeError("broken")
            if index == self.interrupt_at:
                os.kill(os.getpid(), self.signal)
            yield self.output(index, frame)

    def output(self, index: int, frame: Any) -> Output:
        step = SE3.exp(jnp.array([0.0, 0.0, 1.0 if index else 0.0, 0.0, 0.0, 0.0]))
        count = 8 if index else 0
        uv = np.arange(2.0 * count).reshape(count, 2)
        covariance = 1e-4 * np.eye(6)
        return Output(
            time=frame.time,
            pose=SE3.exp(jnp.array([0.0, 0.0, float(index), 0.0, 0.0, 0.0])),
            covariance=index * covariance,
            relative=step,
            relative_covariance=covariance,
            ok=True,
            num_inliers=count,
            num_matches=count,
            timings={"match": 0.01},
            uv_previous=uv,
            uv_current=uv + 1.0,
            inlier=np.ones(count, bool),
        )


class Objects:
    """A pipeline of moving objects that finds none."""

    class Config(eqx.Module):
        odometry: Any = Config()

    def __init__(self, odometry: Pipeline):
        self.odometry = odometry

    def init(self, config: Any, rig: Any) -> int:
        del config, rig
        return 0

    def step(self, index: int, frame: Any, *, pose: Any = None) -> tuple[int, Any]:
        del pose
        none = {"points": np.zeros((0, 2)), "objects": np.zeros((0, 6)), "boxes": np.zeros((0, 4)), "tracks": ()}
        camera = self.odometry.output(index, frame)
        return index + 1, types.SimpleNamespace(
            index=index, odometry=camera, timings={"filter": 0.01}, count=0.0, **none
        )


@pytest.fixture
def pipeline(monkeypatch):
    stand_in = Pipeline()
    module = types.ModuleType("jaxloc.pipelines")
    module.odometry, module.moving_objects = stand_in, Objects(stand_in)
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


@pytest.fixture
def refused(capsys):
    """Checks that a command ends with exit code 2 and one line that says why."""

    def check(arguments, match):
        assert run([str(argument) for argument in arguments]) == 2
        error = capsys.readouterr().err
        assert error.startswith("jaxloc: error: ") and error.count("\n") == 1
        assert re.search(match, error), error

    return check
