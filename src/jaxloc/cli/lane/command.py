"""``jaxloc lane``: lane following in images or a video."""

import dataclasses
import itertools
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from jaxloc.cli import lifecycle
from jaxloc.cli.lane import drawing, report
from jaxloc.cli.lifecycle import Arguments
from jaxloc.data import DataError
from jaxloc.data.camera_file import CameraFile, read_camera
from jaxloc.data.io.writing import RowWriter
from jaxloc.data.road_images import LaneFrame, LaneRecording, open_recording
from jaxloc.sensors.ground_camera import GroundCamera

_FILES = {"lane.csv": "frame,offset,heading,curvature,confidence,ok", "borders.csv": "frame,row,left,right"}


def default_config() -> Any:
    """The default options."""
    from jaxloc.pipelines import lane_following

    return lane_following.Config()


def run_recording(path: Path, camera_path: Path, speed: float | None, arguments: Arguments) -> int:
    """Follows the lane in a recording.

    Args:
        path: image, folder of images, or video.
        camera_path: YAML file of the camera.
        speed: of the vehicle, m/s; None for that of the options.
        arguments: output folder and options.

    Returns:
        The exit code.

    Raises:
        DataError: when any input is bad; nothing is written then.
    """
    lifecycle.prepare(arguments.out)
    file = read_camera(camera_path)
    ground = GroundCamera(file.camera, file.require_height(), file.pitch or 0.0, file.roll or 0.0)
    recording = open_recording(path)
    _check_shape(file, recording)
    config = arguments.read(default_config())
    try:
        config = config if speed is None else dataclasses.replace(config, speed=speed)
    except ValueError as error:
        raise DataError("--speed", str(error)) from None
    state, pitch = _begin(recording, ground, config, file)
    record = report.Record(recording, pitch, float(state.tracker.ground.pitch))
    inputs = {"command": "lane", "path": str(path), "camera": str(camera_path), "speed": speed}
    with lifecycle.open_run(arguments.out) as run, drawing.open_gallery(recording, arguments.out) as gallery:

        def write(pair: tuple[LaneFrame, Any], rows: Mapping[str, RowWriter]) -> None:
            frame, output = pair
            _append(rows["lane.csv"], rows["borders.csv"], frame, output)
            image = drawing.annotate(frame.color, output)
            gallery(frame, image)
            record.add(frame.name, frame.time, output, image)

        run.stream(_outputs(recording, state), write, title="lane", total=len(recording), files=_FILES)
        return run.finish(record, config, inputs, _summary)


def _begin(recording: LaneRecording, ground: GroundCamera, config: Any, file: CameraFile) -> tuple[Any, Any]:
    """The state of the pipeline before the first image, and the pitch where it was estimated."""
    from jaxloc.pipelines import lane_following

    pitch = None
    if file.pitch is None:
        pitch, ground = lane_following.correct_pitch(itertools.islice(recording, config.pitch_frames), ground)
    try:
        sigma = None if pitch is None else pitch.sigma
        return lane_following.init(config, ground, recording.shape, pitch_sigma=sigma), pitch
    except ValueError as error:
        raise DataError(file.path, str(error)) from None


def _outputs(recording: LaneRecording, state: Any) -> Iterator[tuple[LaneFrame, Any]]:
    """Each image with the pipeline's output."""
    from jaxloc.pipelines import lane_following

    for frame in recording:
        state, output = lane_following.step(state, frame)
        yield frame, output


def _check_shape(file: CameraFile, recording: LaneRecording) -> None:
    if file.shape is not None and file.shape != recording.shape:
        sizes = [f"{columns}x{rows}" for rows, columns in (file.shape, recording.shape)]
        raise DataError(file.path, f"is of images of {sizes[0]}, but those of {recording.path} are {sizes[1]}")


def _append(lanes: RowWriter, borders: RowWriter, frame: LaneFrame, output: Any) -> None:
    offset, heading, curvature, _ = output.lane
    lanes.append(f"{frame.index},{offset:.4f},{heading:.6f},{curvature:.7f},{output.confidence:.3f},{output.ok:d}")
    for row, left, right in zip(output.rows, output.left, output.right, strict=True):
        borders.append(f"{frame.index},{row:.0f},{left:.2f},{right:.2f}")


def _summary(metrics: dict[str, Any]) -> str:
    text = f"{metrics['frames']} images, lane measured in {metrics['frames_ok']}"
    if metrics["pitch_estimated"]:
        return f"{text}, pitch estimated: {metrics['pitch_rad']:.4f} rad"
    return f"{text}, pitch not known, taken as zero: no vanishing point found" if metrics["pitch_assumed"] else text
