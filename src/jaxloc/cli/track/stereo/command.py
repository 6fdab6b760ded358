"""``jaxloc track SEQUENCE``: run the pipeline, write rows and images as they come, then metrics and report."""

from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import typer

from jaxloc.cli import configuration, results, session
from jaxloc.cli.track.detections.command import HEADER
from jaxloc.cli.track.stereo import report
from jaxloc.data import DataError, StereoSequence, kitti
from jaxloc.data.io.writing import RowWriter, write_file
from jaxloc.evaluation import plots

_PICTURES = 8  # annotated frames of a run


def run_recording(folder: Path, poses: Path | None, out: Path, config_path: Path | None) -> int:
    """Tracks what moves in a stereo folder in KITTI layout.

    Args:
        folder: with ``image_0``, ``image_1``, ``calib.txt`` and ``times.txt``.
        poses: of the left camera, KITTI rows, taken as exact; None to estimate them.
        out: folder for the results; made if it is not there.
        config_path: YAML file with options; None for the defaults.

    Returns:
        Exit code: 0, or 130 after an interrupt, when the rows, metrics and report end with the last whole frame.

    Raises:
        DataError: when the recording, the poses or the options are bad; nothing is written then.
    """
    config = prepare(out, config_path)
    sequence = kitti.read_sequence(folder, poses)
    with session.show_progress("checking images", len(sequence)) as progress:
        sequence.verify(progress)
    if poses is not None and sequence.truth is None:
        raise DataError(poses, "holds no poses")
    inputs = {"command": "track", "sequence": str(folder), "poses": None if poses is None else str(poses)}
    return run_sequence(
        sequence, config, out, inputs, title=f"Moving objects: {sequence.name}", known=poses is not None
    )


def prepare(out: Path, config_path: Path | None) -> Any:
    """Checks all that can fail before the run: the output folder, the options, the libraries for the report."""
    results.prepare(out)
    from jaxloc.pipelines import moving_objects

    default = moving_objects.Config()
    return default if config_path is None else configuration.read_config(config_path, default)


def run_sequence(
    sequence: StereoSequence, config: Any, out: Path, inputs: dict[str, Any], *, title: str, known: bool = False
) -> int:
    """Runs the pipeline on a sequence and writes everything.

    Args:
        sequence: the frames.
        config: options of the pipeline.
        out: folder for the results.
        inputs: what the command was given.
        title: of the report.
        known: whether the sequence's poses are used in place of the odometry's.

    Returns:
        Exit code.
    """
    record = report.Record(title)
    with session.Interruption() as interruption, session.output_folder(out):
        _stream(sequence, config, out, record, interruption, known)
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
    known: bool,
) -> None:
    """Writes the rows of each frame, and some images, until the end or an interrupt."""
    from jaxloc.pipelines import moving_objects

    poses = None
    if known and sequence.truth is not None:
        poses = sequence.truth.poses
    pictured = set(np.linspace(0, len(sequence) - 1, _PICTURES + 1).round().astype(int)[1:].tolist())
    last: list[Any] = []

    def frames():
        for frame in sequence:
            if interruption.requested:
                return
            last[:] = [frame]
            yield frame

    (out / "images").mkdir(exist_ok=True)
    with ExitStack() as stack:
        rows = stack.enter_context(RowWriter(out / "tracks.csv", HEADER))
        trajectory = stack.enter_context(RowWriter(out / "trajectory.txt"))
        progress = stack.enter_context(session.show_progress("tracking", len(sequence)))
        for step in moving_objects.steps(frames(), sequence.rig, config, poses=poses):
            for track in step.tracks:
                rows.append(_row(step.index, track))
            trajectory.append(kitti.format_pose(np.asarray(step.odometry.pose.matrix(), np.float64)))
            record.add(step)
            if step.index in pictured:
                picture = plots.draw_objects(last[0].left, step.points, step.boxes, *_places(step.tracks))
                record.pictures.append((step.index, picture))
                write_file(out / "images" / f"{step.index:06d}.png", plots.encode(picture))
            progress(step.index + 1)
            if interruption.requested:
                break
        if not record.steps:
            if interruption.requested:
                raise typer.Abort
            raise DataError(sequence.name, "the pipeline gave no frame")


def _row(index: int, track: Any) -> str:
    variances = np.diagonal(track.covariance)[:3]
    numbers = ",".join(f"{x:.6g}" for x in (*track.state, *variances, *track.uv))
    return f"{index},{track.label},{numbers}"


def _places(tracks: tuple[Any, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels, numbers and speeds of tracks."""
    uv = np.array([track.uv for track in tracks]).reshape(-1, 2)
    labels = np.array([track.label for track in tracks], int)
    return uv, labels, np.array([np.linalg.norm(track.state[3:]) for track in tracks])


def _announce(metrics: dict[str, Any], out: Path) -> None:
    typer.echo(
        f"{metrics['frames']} frames, {metrics['tracks']} tracks of moving objects, "
        f"{metrics['frames_per_second']:.1f} frames/s; report: {out / 'report.html'}"
    )
