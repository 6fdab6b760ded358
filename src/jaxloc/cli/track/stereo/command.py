"""``jaxloc track SEQUENCE``: moving objects seen by a stereo camera."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float64

from jaxloc.cli import lifecycle, session
from jaxloc.cli.lifecycle import Arguments
from jaxloc.cli.track.stereo import report
from jaxloc.data import DataError, StereoSequence, kitti
from jaxloc.data.io.writing import RowWriter, write_file
from jaxloc.data.tracking import tracks_csv
from jaxloc.evaluation import plots

_NUM_IMAGES = 8  # annotated frames of a run
_NONE = np.zeros(3)
_FILES = {"tracks.csv": tracks_csv.HEADER, "trajectory.txt": None}


def default_config() -> Any:
    """The default options."""
    from jaxloc.pipelines import moving_objects

    return moving_objects.Config()


def run_recording(folder: Path, poses: Path | None, arguments: Arguments) -> int:
    """Tracks moving objects in a stereo folder in KITTI layout.

    Args:
        folder: with ``image_0``, ``image_1``, ``calib.txt`` and ``times.txt``.
        poses: of the left camera, KITTI rows, taken as exact; None to estimate them.
        arguments: output folder and options.

    Returns:
        Exit code: 0, or 130 or 143 after an interrupt, when the rows, metrics and report end with the last whole frame.

    Raises:
        DataError: when the recording, the poses or the options are bad; nothing is written then.
    """
    lifecycle.prepare(arguments.out)
    config = arguments.read(default_config())
    sequence = kitti.read_sequence(folder, poses)
    with session.show_progress("checking images", len(sequence)) as progress:
        sequence.verify(progress)
    if poses is not None and sequence.truth is None:
        raise DataError(poses, "holds no poses")
    inputs = {"command": "track", "sequence": str(folder), "poses": None if poses is None else str(poses)}
    title = f"Moving objects: {sequence.name}"
    return run_sequence(
        sequence, config, arguments.out, inputs, title=title, known=poses is not None, offset=sequence.offset
    )


def run_sequence(
    sequence: StereoSequence,
    config: Any,
    out: Path,
    inputs: dict[str, Any],
    *,
    title: str,
    known: bool = False,
    offset: Float64[np.ndarray, "3"] = _NONE,
) -> int:
    """Runs the pipeline on a sequence and writes everything.

    Args:
        sequence: the frames.
        config: options of the pipeline.
        out: folder for the results.
        inputs: what the command was given.
        title: of the report.
        known: whether the sequence's poses are used in place of the odometry's.
        offset: of the frame of these poses in the frame of the results, m.

    Returns:
        Exit code.
    """
    record, offset = report.Record(title), offset if known else _NONE
    shown = set(np.linspace(0, len(sequence) - 1, _NUM_IMAGES + 1).round().astype(int)[1:].tolist())

    def write(pair: tuple[Any, Any], rows: Mapping[str, RowWriter]) -> None:
        frame, output = pair
        for track in output.tracks:
            rows["tracks.csv"].append(_row(output.index, track, offset))
        pose = np.array(output.odometry.pose.matrix(), np.float64)
        pose[:3, 3] += offset
        rows["trajectory.txt"].append(kitti.format_pose(pose))
        record.add(output)
        if output.index in shown:
            figure = plots.draw_objects(frame.left, output.points, output.boxes, *_positions(output.tracks))
            record.figures.append((output.index, figure))
            write_file(out / "images" / f"{output.index:06d}.png", plots.encode(figure))

    with lifecycle.open_run(out) as run:
        (out / "images").mkdir(exist_ok=True)
        run.stream(_outputs(sequence, config, known), write, title="tracking", total=len(sequence), files=_FILES)
        return run.finish(record, config, inputs, _summary)


def _outputs(sequence: StereoSequence, config: Any, known: bool) -> Iterator[tuple[Any, Any]]:
    """Each frame with the pipeline's output."""
    from jaxloc.pipelines import moving_objects

    poses = sequence.truth.poses if known and sequence.truth is not None else None
    state = moving_objects.init(config, sequence.rig)
    for index, frame in enumerate(sequence):
        pose = None if poses is None else jax.tree.map(lambda leaf, i=index: leaf[i], poses)
        state, output = moving_objects.step(state, frame, pose=pose)
        yield frame, output


def _row(index: int, track: Any, offset: Float64[np.ndarray, "3"]) -> str:
    state, variances = np.asarray(track.state, float), np.diagonal(track.covariance)[:3]
    return tracks_csv.format_track(index, track.label, state[:3] + offset, state[3:], variances, track.uv)


def _positions(tracks: tuple[Any, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels, numbers and speeds of tracks."""
    uv = np.array([track.uv for track in tracks]).reshape(-1, 2)
    labels = np.array([track.label for track in tracks], int)
    return uv, labels, np.array([np.linalg.norm(track.state[3:]) for track in tracks])


def _summary(metrics: dict[str, Any]) -> str:
    text = f"{metrics['frames']} frames, {metrics['tracks']} tracks of moving objects"
    rate = metrics["frames_per_second"]
    return text if rate is None else f"{text}, {rate:.1f} frames/s"
