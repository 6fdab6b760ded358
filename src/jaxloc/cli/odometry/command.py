"""``jaxloc odometry`` and ``jaxloc demo``: stereo odometry of a recording, or of a synthetic street."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np

from jaxloc.cli import lifecycle, session
from jaxloc.cli.lifecycle import Arguments
from jaxloc.cli.odometry import report
from jaxloc.cli.track.stereo import command as stereo
from jaxloc.data import StereoSequence, covariance_csv, kitti, simulate_street, tum
from jaxloc.data.io.writing import RowWriter

_FILES = {"trajectory.txt": None, "trajectory.tum": None, "covariance.csv": covariance_csv.HEADER}


def default_config() -> Any:
    """The default options."""
    from jaxloc.pipelines import odometry

    return odometry.Config()


def run_recording(folder: Path, poses: Path | None, arguments: Arguments) -> int:
    """Runs odometry on a recording.

    Args:
        folder: KITTI sequence.
        poses: true poses.
        arguments: output folder and options.

    Returns:
        The exit code.

    Raises:
        DataError: when any input is bad; nothing is written then.
    """
    lifecycle.prepare(arguments.out)
    sequence = kitti.read_sequence(folder, poses)
    config = arguments.read(default_config())
    with session.show_progress("checking images", len(sequence)) as progress:
        sequence.verify(progress)
    inputs = {"command": "odometry", "sequence": str(folder), "poses": None if poses is None else str(poses)}
    return _run(sequence, config, arguments.out, inputs, title=f"Stereo odometry: {sequence.name}")


def run_demo(arguments: Arguments, *, num_frames: int, seed: int) -> int:
    """Runs odometry on a synthetic street, then the tracker of moving objects, which writes to ``moving_objects``.

    Args:
        arguments: output folder and options.
        num_frames: number of frames.
        seed: of the street.

    Returns:
        The exit code.

    Raises:
        DataError: when any input is bad; nothing is written then.
    """
    out = arguments.out
    lifecycle.prepare(out)
    config = arguments.read(default_config())
    sequence = simulate_street(num_frames=num_frames, seed=seed)
    inputs = {"command": "demo", "frames": num_frames, "seed": seed}
    code = _run(sequence, config, out, inputs, title="Stereo odometry on a synthetic street")
    if code:
        return code
    objects = eqx.tree_at(lambda c: c.odometry, stereo.default_config(), config)
    title = "Moving objects on a synthetic street"
    return stereo.run_sequence(sequence, objects, out / "moving_objects", inputs, title=title)


def _run(sequence: StereoSequence, config: Any, out: Path, inputs: dict[str, Any], *, title: str) -> int:
    from jaxloc.pipelines import odometry

    record = report.Record(title, sequence)

    def write(output: Any, rows: Mapping[str, RowWriter]) -> None:
        matrix = np.asarray(output.pose.matrix(), dtype=np.float64)
        rows["trajectory.txt"].append(kitti.format_pose(matrix))
        rows["trajectory.tum"].append(tum.format_pose(float(output.time), matrix))
        rows["covariance.csv"].append(covariance_csv.format_covariance(len(record.matrices), output.covariance))
        record.add(output, matrix)

    with lifecycle.open_run(out) as run:
        outputs = odometry.run(sequence, config, sequence.rig)
        run.stream(outputs, write, title="odometry", total=len(sequence), files=_FILES)
        return run.finish(record, config, inputs, _summary)


def _summary(metrics: dict[str, Any]) -> str:
    text = f"{metrics['frames']} frames, {metrics['distance_m']:.1f} m"
    return f"{text}, drift {metrics['end_drift_percent']:.2f} %" if "end_drift_percent" in metrics else text
