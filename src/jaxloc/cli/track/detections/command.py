"""``jaxloc track --detections``: tracking by detection, from the outputs of any detector."""

import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float64

from jaxloc.cli import lifecycle
from jaxloc.cli.lifecycle import Arguments
from jaxloc.cli.track.detections import report
from jaxloc.data import DataError
from jaxloc.data.io.offset import choose_offset, subtract_offset
from jaxloc.data.io.text import read_text
from jaxloc.data.io.writing import RowWriter
from jaxloc.data.tracking import Detections, LabeledTracks, kitti_tracking, mot, tracks_csv

TRACKERS = ("gmphd", "jpda", "gnn")
FORMATS = ("auto", "kitti", "mot")
_KITTI_COLUMNS, _MOT_COLUMNS = 15, range(7, 11)


class Inputs(eqx.Module):
    """Arguments of the command.

    Attributes:
        detections: file of a detector.
        form: format of the files, one of `FORMATS`.
        poses: file of camera poses, 12 numbers a line (KITTI only).
        calibration: file of the cameras (KITTI only).
        truth: file of true tracks, in the format of the detections.
        tracker: one of `TRACKERS`.
    """

    detections: Path
    form: str = "auto"
    poses: Path | None = None
    calibration: Path | None = None
    truth: Path | None = None
    tracker: str = "gmphd"


def default_config(form: str = "kitti", tracker: str = "gmphd") -> Any:
    """The default options for a format and a tracker."""
    from jaxloc.pipelines import detection_tracking

    strategy = detection_tracking.STRATEGIES[tracker]()
    if form == "mot":
        return detection_tracking.Config.for_boxes(strategy)
    return detection_tracking.Config(strategy)


def run_detections(inputs: Inputs, arguments: Arguments) -> int:
    """Tracks objects by their detections.

    Args:
        inputs: files.
        arguments: output folder and options.

    Returns:
        The exit code.

    Raises:
        DataError: when any input is bad; nothing is written then.
    """
    lifecycle.prepare(arguments.out)
    form = _find_format(inputs)
    found, truth, poses, offset = _read_kitti(inputs) if form == "kitti" else _read_mot(inputs)
    if not found.valid.any():
        raise DataError(inputs.detections, "holds no detection that can be used")
    projection = None
    if inputs.calibration is not None:
        projection = kitti_tracking.read_calibration(inputs.calibration).projections[2]
    config = arguments.read(default_config(form, inputs.tracker))
    record = report.Record(f"Tracks: {inputs.detections.name}", found, truth=truth, cameras=poses, offset=offset)

    def write(pair: tuple[float, Any], rows: Mapping[str, RowWriter]) -> None:
        record.add(*pair)
        for slot in range(len(record.outputs[-1])):
            rows["tracks.csv"].append(_row(record, len(record.outputs) - 1, slot, projection))

    files = {"tracks.csv": tracks_csv.HEADER}
    plain = {name: None if value is None else str(value) for name, value in vars(inputs).items()}
    with lifecycle.open_run(arguments.out) as run:
        run.stream(_outputs(found, poses, config), write, title="tracking", total=len(found), files=files)
        mot.write_mot(arguments.out / "tracks_mot.txt", record.labeled_tracks())
        return run.finish(record, config, {"command": "track", **plain, "form": form}, _summary)


def _find_format(inputs: Inputs) -> str:
    """The format of the detections: that which is named, or by the number of columns."""
    form = inputs.form
    if form == "auto":
        lines = read_text(inputs.detections).splitlines()
        columns = len(next((line.replace(",", " ").split() for line in lines if line.strip()), []))
        form = "kitti" if columns == _KITTI_COLUMNS else "mot" if columns in _MOT_COLUMNS else ""
    if not form:
        raise DataError(inputs.detections, "has an unknown format; name one by --format kitti or mot")
    if form == "mot":
        for name, path in (("--poses", inputs.poses), ("--calib", inputs.calibration)):
            if path is not None:
                raise DataError(name, "does not apply to boxes in images (format mot)")
    return form


def _read_kitti(inputs: Inputs) -> tuple[Detections, LabeledTracks | None, np.ndarray | None, np.ndarray]:
    """Detections, truth and poses of the camera in a frame at an offset, and that offset."""
    poses, offset = None, np.zeros(3)
    if inputs.poses is not None:
        poses = kitti_tracking.read_camera_poses(inputs.poses)
        offset = choose_offset(poses[:, :3, 3])
        poses[:, :3, 3] = subtract_offset(inputs.poses, poses[:, :3, 3], offset)
    count = None if poses is None else len(poses)
    found = kitti_tracking.read_detections(inputs.detections, num_frames=count, poses=poses)
    if inputs.truth is None:
        return found, None, poses, offset
    kinds = np.unique(found.types[found.valid])
    types = tuple(kitti_tracking.TYPES[kind] for kind in kinds)
    truth = kitti_tracking.read_labels(inputs.truth, types=types, num_frames=count, poses=poses)
    if count is None:
        count = max(len(found), len(truth.detections))
        found = kitti_tracking.read_detections(inputs.detections, num_frames=count)
        truth = kitti_tracking.read_labels(inputs.truth, types=types, num_frames=count)
    return found, truth, poses, offset


def _read_mot(inputs: Inputs) -> tuple[Detections, LabeledTracks | None, None, np.ndarray]:
    found = mot.read_mot_detections(inputs.detections)
    if inputs.truth is None:
        return found, None, None, np.zeros(2)
    truth = mot.read_mot_tracks(inputs.truth)
    count = max(len(found), len(truth.detections))
    found = mot.read_mot_detections(inputs.detections, num_frames=count)
    return found, mot.read_mot_tracks(inputs.truth, num_frames=count), None, np.zeros(2)


def _outputs(found: Detections, poses: np.ndarray | None, config: Any) -> Iterator[tuple[float, Any]]:
    """The tracks of each frame, with the seconds since the last one."""
    from jaxloc.pipelines import detection_tracking

    places = found.positions
    if places is None:
        sides = found.boxes[..., 2:] - found.boxes[..., :2]
        places = np.concatenate([report.centers(found.boxes), sides], axis=2)
    frames = detection_tracking.split_frames(places, found.scores, found.valid, found.times, cameras=poses)
    start = time.perf_counter()
    for output in detection_tracking.run(frames, config):
        yield time.perf_counter() - start, output
        start = time.perf_counter()


def _row(record: report.Record, frame: int, slot: int, projection: np.ndarray | None) -> str:
    """A row of the table: in the world, or of the center of a box in px."""
    output, size = record.outputs[frame], 3 if record.in_world else 2
    variances = np.diagonal(output.covariances[slot])[:size]
    uv = _pixel(record, frame, slot, projection)
    number, identity = int(record.found.frames[frame]), int(output.ids[slot])
    position = np.asarray(output.places[slot, :size], np.float64) + record.offset
    return tracks_csv.format_track(number, identity, position, output.velocities[slot, :size], variances, uv)


def _pixel(record: report.Record, frame: int, slot: int, projection: Float64[np.ndarray, "3 4"] | None) -> list[float]:
    """A track's position in the image where the camera is known, else the center of its box."""
    if projection is None:
        box = record.boxes[frame][slot]
        return [] if box is None else report.centers(box).tolist()
    pose = np.eye(4) if record.cameras is None else record.cameras[frame]
    position = pose[:3, :3].T @ (record.outputs[frame].places[slot] - pose[:3, 3])
    x, y, depth = projection @ [*position, 1.0]
    return [x / depth, y / depth] if depth > 0 else []


def _summary(metrics: dict[str, Any]) -> str:
    text = f"{metrics['frames']} frames, {metrics['tracks']} tracks"
    return text if metrics.get("hota") is None else f"{text}, HOTA {metrics['hota']:.3f}"
