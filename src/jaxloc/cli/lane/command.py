"""``jaxloc lane``: follow the lane, write a row an image as they come, then metrics and report."""

import dataclasses
import itertools
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import typer

from jaxloc.cli import configuration, results, session
from jaxloc.cli.lane import drawing, report
from jaxloc.data import DataError
from jaxloc.data.camera_file import CameraFile, read_camera
from jaxloc.data.io.writing import RowWriter
from jaxloc.data.road_images import LaneFrame, LaneRecording, open_recording
from jaxloc.sensors.ground_camera import GroundCamera


def run_recording(path: Path, camera_path: Path, speed: float, out: Path, config_path: Path | None) -> int:
    """Follows the lane in a recording.

    Args:
        path: image, folder of images, or video.
        camera_path: YAML file of the camera.
        speed: of the vehicle, m/s.
        out: folder for the results.
        config_path: YAML file with options.

    Returns:
        The exit code.

    Raises:
        DataError: when any input is bad; nothing is written then.
    """
    results.prepare(out)
    file = read_camera(camera_path)
    height = file.require_height()
    recording = open_recording(path)
    _check_shape(file, recording)
    from jaxloc.pipelines import lane_following as pipeline

    default = pipeline.Config()
    config = default if config_path is None else configuration.read_config(config_path, default)
    try:
        config = dataclasses.replace(config, speed=speed)
    except ValueError as error:
        raise DataError("--speed", str(error)) from None
    ground = GroundCamera(file.camera, height, file.pitch or 0.0, file.roll or 0.0)
    pitch = None
    if file.pitch is None:
        pitch, ground = pipeline.level(itertools.islice(recording, config.pitch_frames), ground)
    try:
        sigma = None if pitch is None else pitch.sigma
        follower = pipeline.LaneFollower(ground, recording.shape, config, pitch_sigma=sigma)
    except ValueError as error:
        raise DataError(camera_path, str(error)) from None
    record = report.Record(recording, pitch, float(ground.pitch))
    inputs = {"command": "lane", "path": str(path), "camera": str(camera_path), "speed": speed}
    with session.Interruption() as interruption, session.output_folder(out):
        _stream(recording, follower, out, record, interruption)
        record.interrupted = interruption.requested
        metrics = results.write(record, config, out, inputs)
    _announce(metrics, out)
    return 130 if record.interrupted else 0


def _check_shape(file: CameraFile, recording: LaneRecording) -> None:
    if file.shape is not None and file.shape != recording.shape:
        sizes = [f"{columns}x{rows}" for rows, columns in (file.shape, recording.shape)]
        raise DataError(file.path, f"is of images of {sizes[0]}, but those of {recording.path} are {sizes[1]}")


def _stream(
    recording: LaneRecording,
    follower: Any,
    out: Path,
    record: report.Record,
    interruption: session.Interruption,
) -> None:
    """Writes the rows and the annotated image of each image, until the end or an interrupt."""
    with ExitStack() as stack:
        lanes = stack.enter_context(RowWriter(out / "lane.csv", "frame,offset,heading,curvature,confidence,ok"))
        borders = stack.enter_context(RowWriter(out / "borders.csv", "frame,row,left,right"))
        gallery = stack.enter_context(drawing.open_gallery(recording, out))
        progress = stack.enter_context(session.show_progress("lane", len(recording)))
        for frame in recording:
            step = follower.follow(frame)
            _append(lanes, borders, frame, step)
            picture = drawing.annotate(frame.color, step)
            gallery(frame, picture)
            record.add(frame.name, frame.time, step, picture)
            progress(frame.index + 1)
            if interruption.requested:
                break
        if not record.steps:
            raise typer.Abort


def _append(lanes: RowWriter, borders: RowWriter, frame: LaneFrame, step: Any) -> None:
    offset, heading, curvature, _ = step.lane
    lanes.append(f"{frame.index},{offset:.4f},{heading:.6f},{curvature:.7f},{step.confidence:.3f},{step.ok:d}")
    for row, left, right in zip(step.rows, step.left, step.right, strict=True):
        borders.append(f"{frame.index},{row:.0f},{left:.2f},{right:.2f}")


def _announce(metrics: dict[str, Any], out: Path) -> None:
    words = [f"{metrics['frames']} images", f"lane seen in {metrics['frames_ok']}"]
    if metrics["pitch_estimated"]:
        words.append(f"pitch estimated: {metrics['pitch_rad']:.4f} rad")
    elif metrics["pitch_assumed"]:
        words.append("pitch not known, taken as zero: no vanishing point found")
    if metrics["interrupted"]:
        words.append("interrupted")
    typer.echo(f"{', '.join(words)}: {out / 'report.html'}")
