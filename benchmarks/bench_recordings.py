"""Stereo odometry on the two KITTI clips, where they lie beside the checkout; nothing where they do not."""

from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jaxloc as jl
from benchmarks.metric import ACCURACY, REPOSITORY, TIME, Metric
from jaxloc.evaluation import trajectories
from jaxloc.evaluation.trajectories import kitti_drift

_SEQUENCES = REPOSITORY.parent / "shared" / "data" / "kitti_odometry" / "sequences"


def metrics(smoke: bool) -> Iterator[Metric]:
    for name in ("06", "01"):
        folder = _SEQUENCES / name
        if folder.is_dir():
            yield from _clip(name, folder, smoke)


def _clip(name: str, folder: Path, smoke: bool) -> Iterator[Metric]:
    odometry = jl.pipelines.odometry
    sequence = jl.data.kitti.read_sequence(folder, None)
    frames = [sequence[i] for i in range(5 if smoke else len(sequence))]
    key, config = f"recordings.kitti_{name}", odometry.Config()
    list(odometry.run(frames[:3], config, sequence.rig))  # compiles
    steps = list(odometry.run(frames, config, sequence.rig))
    yield from _accuracy(key, steps, sequence.truth)
    stages = {stage: [step.timings[stage] for step in steps[1:]] for stage in steps[-1].timings}
    for stage, seconds in stages.items():
        yield Metric(f"{key}.stage.{stage}", 1e3 * float(np.median(seconds)), "ms")
    total = np.median([sum(step.timings.values()) for step in steps[1:]])
    yield Metric(f"{key}.frames_per_second", 1.0 / float(total), "1/s", "higher", TIME)
    offset = float(odometry.calibrate_disparity(frames[:20], sequence.rig, config).mean[0])
    yield Metric(f"{key}.disparity_offset", offset, "px", "equal", ACCURACY)
    mended = odometry.Config(matching=jl.odometry.MatchingOptions(disparity_offset=offset))
    yield from _accuracy(f"{key}.calibrated", list(odometry.run(frames, mended, sequence.rig)), sequence.truth)


def _accuracy(key: str, steps: list, truth: jl.poses.Trajectory) -> Iterator[Metric]:
    """Drift at the end, rotation between frames, and the estimated length over the true one."""
    poses = jax.tree.map(lambda *leaves: jnp.stack(leaves), *[step.pose for step in steps])
    path = jl.poses.Trajectory(truth.times[: len(steps)], poses)
    truth = jl.poses.Trajectory(path.times, truth[: len(steps)])
    yield Metric(f"{key}.drift", float(kitti_drift.end_drift_percent(path, truth)), "%", "lower", ACCURACY)
    rotation = jnp.rad2deg(trajectories.rpe(path, truth).rotation.median())
    yield Metric(f"{key}.rotation", float(rotation), "deg/frame", "lower", ACCURACY)
    yield Metric(f"{key}.length_ratio", float(path.length() / truth.length()), "", "equal", ACCURACY)
