"""``jaxloc mosaic``: a mosaic of a floor from images and odometry."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from jaxloc.cli import lifecycle
from jaxloc.cli.lifecycle import Arguments
from jaxloc.cli.mosaic import report
from jaxloc.data import DataError, tum
from jaxloc.data.camera_file import read_camera
from jaxloc.data.io.files import natural_order
from jaxloc.data.io.images import SUFFIXES, read_gray
from jaxloc.data.io.writing import write_file
from jaxloc.data.tum import StampedTrajectory, planar_poses
from jaxloc.poses.planar import planar_matrix, relative_poses

_LIGHTEST = 255.0


def default_config() -> Any:
    """The default options."""
    from jaxloc.pipelines import floor_mosaic

    return floor_mosaic.Config()


def run_frames(frames: Path, odometry: Path, camera: Path, arguments: Arguments) -> int:
    """Makes a mosaic of a folder of images.

    Args:
        frames: folder; images are taken in the order of their names.
        odometry: TUM file with a pose of the camera over the floor for each image: x to the top of the image, y to
            its left; only the motions between rows count, and only in the plane.
        camera: file of the camera, with its height over the floor.
        arguments: output folder and options.

    Returns:
        The exit code.

    Raises:
        DataError: when any input is bad; nothing is written then.
    """
    lifecycle.prepare(arguments.out)
    paths = find_images(frames)
    times, poses = planar_poses(_read_odometry(odometry, len(paths)))
    ground, shape = _read_ground(camera)
    images = _read_images(paths, shape)
    config = arguments.read(default_config())
    inputs = {"command": "mosaic", "frames": str(frames), "odometry": str(odometry), "camera": str(camera)}
    with lifecycle.open_run(arguments.out) as run:
        last: dict[str, Any] = {}
        try:
            outputs = _register(images, poses, ground, config)
            run.stream(outputs, lambda state, _: last.update(state=state), title="registration", total=len(paths))
            built = _finish(last["state"])
        except ValueError as error:
            raise DataError(odometry, " ".join(str(error).split())) from None
        if not built.used.any():
            raise DataError(frames, "no image overlaps another: there is nothing to join")
        count = len(built.poses)
        _write_map(built, arguments.out)
        _write_path(times[:count], built.poses, arguments.out)
        record = report.Record(tuple(path.name for path in paths[:count]), times[:count], poses[:count], built)
        return run.finish(record, config, inputs, _summary)


def _register(images: np.ndarray, poses: np.ndarray, ground: Any, config: Any) -> Iterator[Any]:
    """The state of the pipeline after each image."""
    from jaxloc.pipelines import floor_mosaic

    view = floor_mosaic.make_view(images, ground, config)
    state = floor_mosaic.init(config, view, initial=poses[0])
    for frame in floor_mosaic.split_frames(images, relative_poses(poses[:-1], poses[1:]), config=config):
        state, _ = floor_mosaic.step(state, frame)
        yield state


def _finish(state: Any) -> Any:
    from jaxloc.pipelines import floor_mosaic

    return floor_mosaic.finish(state)


def find_images(folder: Path) -> list[Path]:
    """Images of a folder, in the order of their names and of numbers in them.

    Raises:
        DataError: when there is no such folder, or less than two images in it.
    """
    if not folder.is_dir():
        raise DataError(folder, "no such folder")
    paths = sorted((path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES), key=natural_order)
    if len(paths) < 2:
        raise DataError(
            folder, f"holds {len(paths)} images ({', '.join(sorted(SUFFIXES))}); a mosaic needs two or more"
        )
    return paths


def _read_odometry(path: Path, count: int) -> StampedTrajectory:
    stamped = tum.read_trajectory(path)
    if len(stamped.trajectory) != count:
        raise DataError(path, f"has {len(stamped.trajectory)} poses for {count} images; give one an image")
    return stamped


def _read_ground(path: Path) -> tuple[Any, tuple[int, int] | None]:
    """The camera over the floor, and the size of its images where the file says it."""
    from jaxloc.sensors.ground_camera import GroundCamera

    record = read_camera(path)
    height = record.require_height()
    # By default a camera looks straight down.
    pitch = 0.5 * np.pi if record.pitch is None else record.pitch
    ground = GroundCamera(record.camera, height, pitch=pitch, roll=0.0 if record.roll is None else record.roll)
    return ground, record.shape


def _read_images(paths: list[Path], shape: tuple[int, int] | None) -> np.ndarray:
    images = []
    for path in paths:
        image = read_gray(path)
        rows, columns = image.shape if shape is None else shape
        shape = (rows, columns)
        if image.shape != shape:
            size = f"{image.shape[1]} x {image.shape[0]}"
            raise DataError(path, f"has {size} pixels, must have {columns} x {rows} as the camera or the first one")
        images.append(image)
    return np.stack(images)


def _write_map(built: Any, out: Path) -> None:
    """The image (its first row is the top: the largest y), gaps black, and its place on the floor."""
    mosaic = built.mosaic
    values = np.clip(np.rint(np.asarray(mosaic.values)), 1.0, _LIGHTEST)
    image = np.where(np.asarray(mosaic.known), values, 0.0).astype(np.uint8)[::-1]
    write_file(out / "mosaic.png", cv2.imencode(".png", image)[1].tobytes())
    resolution = float(mosaic.raster.resolution)
    # As in maps of the ROS map server: the corner of the lower left pixel, not its center.
    x, y = np.asarray(mosaic.raster.origin, np.float64) - 0.5 * resolution
    lines = (f"image: mosaic.png\nresolution: {resolution:.9g}", f"origin: [{x:.9g}, {y:.9g}, 0]", "gap: 0", "")
    write_file(out / "mosaic.yaml", "\n".join(lines))


def _write_path(times: np.ndarray, poses: np.ndarray, out: Path) -> None:
    rows = [tum.format_pose(float(time), planar_matrix(pose)) + "\n" for time, pose in zip(times, poses, strict=True)]
    write_file(out / "trajectory.tum", "".join(rows))


def _summary(metrics: dict[str, Any]) -> str:
    words = [f"{metrics['images_used']} of {metrics['images']} images joined"]
    if metrics["left_out"]:
        words.append("left out: " + ", ".join(metrics["left_out"][:5]) + (", ..." * (len(metrics["left_out"]) > 5)))
    return "; ".join([*words, f"{metrics['loop_closures']} loop closures"])
