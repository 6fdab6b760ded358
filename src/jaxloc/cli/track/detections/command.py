"""``jaxloc track --detections``: read what a detector found, track it, write tables, metrics and report."""

import time
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np
import typer
from jaxtyping import Bool, Float64

from jaxloc.cli import configuration, results, session
from jaxloc.cli.track.detections import report
from jaxloc.data import DataError
from jaxloc.data.io.text import read_text
from jaxloc.data.io.writing import RowWriter
from jaxloc.data.tracking import Detections, LabelledTracks, kitti_tracking, mot

HEADER = "frame,id,x,y,z,vx,vy,vz,var_x,var_y,var_z,u,v"
TRACKERS = ("gmphd", "jpda", "gnn")
FORMATS = ("auto", "kitti", "mot")
_KITTI_WORDS, _MOT_WORDS = 15, range(7, 11)


class Inputs(eqx.Module):
    """What the command was given.

    Attributes:
        detections: file of a detector.
        form: of the files, one of `FORMATS`.
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


def run_detections(inputs: Inputs, out: Path, config_path: Path | None) -> int:
    """Tracks ready detections.

    Args:
        inputs: files.
        out: folder for the results.
        config_path: YAML file with options.

    Returns:
        The exit code.

    Raises:
        DataError: when any input is bad; nothing is written then.
    """
    results.prepare(out)
    form = _form(inputs)
    found, truth, poses = _read_kitti(inputs) if form == "kitti" else _read_mot(inputs)
    if not found.valid.any():
        raise DataError(inputs.detections, "holds no detection that can be used")
    projection = None
    if inputs.calibration is not None:
        projection = kitti_tracking.read_calibration(inputs.calibration).projections[2]
    config = _config(inputs, form, config_path)
    plain = {name: None if value is None else str(value) for name, value in vars(inputs).items()}
    with session.output_folder(out):
        record = _run(found, truth, poses, config, title=f"Tracks: {inputs.detections.name}")
        with RowWriter(out / "tracks.csv", HEADER) as rows:
            for frame in range(len(found)):
                for slot in np.flatnonzero(record.tracked.valid[frame]).tolist():
                    rows.append(_row(record, frame, slot, projection))
        mot.write_mot(out / "tracks_mot.txt", record.tracks())
        metrics = results.write(record, config, out, {"command": "track", **plain, "form": form})
    _announce(metrics, out)
    return 0


def _form(inputs: Inputs) -> str:
    """The format of the detections: that which is named, or as many numbers a line as it has."""
    form = inputs.form
    if form == "auto":
        lines = read_text(inputs.detections).splitlines()
        words = next((line.replace(",", " ").split() for line in lines if line.strip()), [])
        form = "kitti" if len(words) == _KITTI_WORDS else "mot" if len(words) in _MOT_WORDS else ""
    if not form:
        raise DataError(inputs.detections, "is in no format that is known; name one by --format kitti or mot")
    if form == "mot":
        for name, path in (("--poses", inputs.poses), ("--calib", inputs.calibration)):
            if path is not None:
                raise DataError(name, "is of no use to boxes in images (format mot)")
    return form


def _read_kitti(inputs: Inputs) -> tuple[Detections, LabelledTracks | None, np.ndarray | None]:
    poses = None if inputs.poses is None else kitti_tracking.read_camera_poses(inputs.poses)
    count = None if poses is None else len(poses)
    found = kitti_tracking.read_detections(inputs.detections, num_frames=count, poses=poses)
    if inputs.truth is None:
        return found, None, poses
    kinds = np.unique(found.types[found.valid])
    types = tuple(kitti_tracking.TYPES[kind] for kind in kinds)
    truth = kitti_tracking.read_labels(inputs.truth, types=types, num_frames=count, poses=poses)
    if count is None:
        count = max(len(found), len(truth.detections))
        found = kitti_tracking.read_detections(inputs.detections, num_frames=count)
        truth = kitti_tracking.read_labels(inputs.truth, types=types, num_frames=count)
    return found, truth, poses


def _read_mot(inputs: Inputs) -> tuple[Detections, LabelledTracks | None, None]:
    found = mot.read_mot_detections(inputs.detections)
    if inputs.truth is None:
        return found, None, None
    truth = mot.read_mot_tracks(inputs.truth)
    count = max(len(found), len(truth.detections))
    found = mot.read_mot_detections(inputs.detections, num_frames=count)
    return found, mot.read_mot_tracks(inputs.truth, num_frames=count), None


def _config(inputs: Inputs, form: str, path: Path | None) -> Any:
    from jaxloc.pipelines import detection_tracking as pipeline

    strategy = pipeline.STRATEGIES[inputs.tracker]()
    default = pipeline.Config(strategy) if form == "kitti" else pipeline.Config.for_boxes(strategy)
    return default if path is None else configuration.read_config(path, default)


def _run(
    found: Detections, truth: LabelledTracks | None, poses: np.ndarray | None, config: Any, title: str
) -> report.Record:
    """The pipeline, twice: the second pass shows how quick it is once it is compiled."""
    from jaxloc.pipelines import detection_tracking as pipeline

    places = found.positions
    if places is None:
        sides = found.boxes[..., 2:] - found.boxes[..., :2]
        places = np.concatenate([report.centers(found.boxes), sides], axis=2)
    seconds = []
    for _ in range(2):
        start = time.perf_counter()
        tracked = pipeline.track(places, found.scores, found.valid, found.times, cameras=poses, config=config)
        seconds.append(time.perf_counter() - start)
    boxes, boxed = _boxes(found, tracked)
    first, second = seconds
    return report.Record(title, found, tracked, boxes, boxed, truth=truth, cameras=poses, seconds=(first, second))


def _boxes(found: Detections, tracked: Any) -> tuple[Float64[np.ndarray, "t k 4"], Bool[np.ndarray, "t k"]]:
    """Boxes of tracks, and which have one: of a solid that of its detection, or of its last one."""
    if found.positions is None:
        center, sides = tracked.places[..., :2], np.maximum(tracked.places[..., 2:], 1.0)
        boxes = np.concatenate([center - 0.5 * sides, center + 0.5 * sides], axis=2)
        return np.where(tracked.valid[..., None], boxes, 0.0), tracked.valid
    boxes = np.zeros((*tracked.valid.shape, 4))
    boxed = np.zeros(tracked.valid.shape, bool)
    last: dict[int, np.ndarray] = {}
    for frame, slot in np.argwhere(tracked.valid):
        identity, detection = int(tracked.ids[frame, slot]), tracked.slots[frame, slot]
        if detection >= 0:
            last[identity] = found.boxes[frame, detection]
        if identity in last:
            boxes[frame, slot], boxed[frame, slot] = last[identity], True
    return boxes, boxed


def _row(record: report.Record, frame: int, slot: int, projection: np.ndarray | None) -> str:
    """A row of the table: in the world, or of the center of a box in px, without z."""
    tracked = record.tracked
    size = 3 if record.solid else 2
    place, velocity = tracked.places[frame, slot], tracked.velocities[frame, slot]
    variances = np.diagonal(tracked.covariances[frame, slot])
    words = []
    for values in (place, velocity, variances):
        words += [f"{value:.6g}" for value in values[:size]] + [""] * (3 - size)
    words += [f"{value:.6g}" for value in _pixel(record, frame, slot, projection)] or ["", ""]
    return ",".join([str(record.found.frames[frame]), str(tracked.ids[frame, slot]), *words])


def _pixel(record: report.Record, frame: int, slot: int, projection: np.ndarray | None) -> list[float]:
    """Where a track is in the image: its place, where the camera is known, else the center of its box."""
    if projection is None:
        boxed = record.boxed[frame, slot]
        return report.centers(record.boxes[frame : frame + 1])[0, slot].tolist() if boxed else []
    pose = np.eye(4) if record.cameras is None else record.cameras[frame]
    x, y, depth = projection @ [*(pose[:3, :3].T @ (record.tracked.places[frame, slot] - pose[:3, 3])), 1.0]
    return [x / depth, y / depth] if depth > 0 else []


def _announce(metrics: dict[str, Any], out: Path) -> None:
    words = [f"{metrics['frames']} frames", f"{metrics['tracks']} tracks"]
    if metrics.get("hota") is not None:
        words.append(f"HOTA {metrics['hota']:.3f}")
    typer.echo(f"{', '.join(words)}: {out / 'report.html'}")
