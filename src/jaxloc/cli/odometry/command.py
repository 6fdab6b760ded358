"""``jaxloc odometry`` and ``jaxloc demo``: run the pipeline, write its rows as they come, then metrics and report."""

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np
import typer

from jaxloc.cli import configuration, results, session
from jaxloc.cli.odometry import report
from jaxloc.cli.track.stereo import command
from jaxloc.data import DataError, StereoFrame, StereoSequence, covariance, kitti, simulate_street, tum
from jaxloc.data.io.writing import RowWriter


def run_recording(folder: Path, poses: Path | None, out: Path, config_path: Path | None) -> int:
    """Runs odometry on a recording.

    Args:
        folder: KITTI sequence.
        poses: true poses.
        out: folder for the results.
        config_path: YAML file with options.

    Returns:
        The exit code.

    Raises:
        DataError: when any input is bad; nothing is written then.
    """
    sequence = kitti.read_sequence(folder, poses)
    config = _prepare(out, config_path)
    with session.show_progress("checking images", len(sequence)) as progress:
        sequence.verify(progress)
    inputs = {"command": "odometry", "sequence": str(folder), "poses": None if poses is None else str(poses)}
    return _run(sequence, config, out, inputs, title=f"Stereo odometry: {sequence.name}")


def run_demo(out: Path, config_path: Path | None, *, num_frames: int, seed: int) -> int:
    """Runs odometry on a synthetic street, then the tracker of moving objects, which writes to ``moving_objects``.

    Args:
        out: folder for the results.
        config_path: YAML file with options.
        num_frames: how many frames.
        seed: which street.

    Returns:
        The exit code.

    Raises:
        DataError: when any input is bad; nothing is written then.
    """
    config = _prepare(out, config_path)
    sequence = simulate_street(num_frames=num_frames, seed=seed)
    inputs = {"command": "demo", "frames": num_frames, "seed": seed}
    code = _run(sequence, config, out, inputs, title="Stereo odometry on a synthetic street")
    if code:
        return code
    from jaxloc.pipelines import moving_objects

    objects = eqx.tree_at(lambda c: c.odometry, moving_objects.Config(), config)
    title = "Moving objects on a synthetic street"
    return command.run_sequence(sequence, objects, out / "moving_objects", inputs, title=title)


def _prepare(out: Path, config_path: Path | None) -> Any:
    """Checks all that can fail before the run: the output folder, the options, the libraries for the report."""
    results.prepare(out)
    from jaxloc.pipelines import odometry

    default = odometry.Config()
    return default if config_path is None else configuration.read_config(config_path, default)


def _run(sequence: StereoSequence, config: Any, out: Path, inputs: dict[str, Any], *, title: str) -> int:
    record = report.Record(title, sequence)
    with session.Interruption() as interruption, session.output_folder(out):
        _stream(sequence, config, out, record, interruption)
        record.interrupted = interruption.requested
        metrics = results.write(record, config, out, inputs)
    _announce(metrics, out)
    return 130 if record.interrupted else 0


def _stream(
    sequence: StereoSequence,
    config: Any,
    out: Path,
    record: report.Record,
    interruption: session.Interruption,
) -> None:
    """Writes a row of every file for each frame, until the end or an interrupt."""
    from jaxloc.pipelines import odometry

    with ExitStack() as stack:
        poses = stack.enter_context(RowWriter(out / "trajectory.txt"))
        stamped = stack.enter_context(RowWriter(out / "trajectory.tum"))
        covariances = stack.enter_context(RowWriter(out / "covariance.csv", covariance.HEADER))
        progress = stack.enter_context(session.show_progress("odometry", len(sequence)))
        for index, step in enumerate(odometry.steps(_until(sequence, interruption), sequence.rig, config)):
            matrix = np.asarray(step.pose.matrix(), dtype=np.float64)
            poses.append(kitti.format_pose(matrix))
            stamped.append(tum.format_pose(float(step.time), matrix))
            covariances.append(covariance.format_covariance(index, step.covariance))
            record.add(step, matrix)
            progress(index + 1)
            if interruption.requested:
                break
        if not record.matrices:
            if interruption.requested:
                raise typer.Abort  # nothing was estimated: leave nothing behind
            raise DataError(sequence.name, "the pipeline gave no pose")


def _until(sequence: StereoSequence, interruption: session.Interruption) -> Iterator[StereoFrame]:
    for frame in sequence:
        if interruption.requested:
            return
        yield frame


def _announce(metrics: dict[str, Any], out: Path) -> None:
    words = [f"{metrics['frames']} frames, {metrics['distance_m']:.1f} m"]
    if "end_drift_percent" in metrics:
        words.append(f"drift {metrics['end_drift_percent']:.2f} %")
    if metrics["interrupted"]:
        words.append("interrupted")
    typer.echo(f"{', '.join(words)}: {out / 'report.html'}")
