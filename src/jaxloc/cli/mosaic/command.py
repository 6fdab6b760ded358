"""``jaxloc mosaic``: join images of a floor to a map, then metrics and report."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import typer

from jaxloc.cli import configuration, results, session
from jaxloc.cli.mosaic import report
from jaxloc.data import DataError, tum
from jaxloc.data.camera_file import read_camera
from jaxloc.data.io.writing import write_file
from jaxloc.data.tum import StampedTrajectory
from jaxloc.poses.planar import relative_poses

_ENDINGS = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm")
_LIGHTEST = 255.0


def run_frames(frames: Path, odometry: Path, camera: Path, out: Path, config_path: Path | None) -> int:
    """Makes a mosaic of a folder of images.

    Args:
        frames: folder; images are taken in the order of their names.
        odometry: TUM file with a pose of the camera over the floor for each image: x to the top of the image, y to
            its left; only the motions between rows count, and only in the plane.
        camera: file of the camera, with its height over the floor.
        out: folder for the results.
        config_path: YAML file with options.

    Returns:
        The exit code.

    Raises:
        DataError: when any input is bad; nothing is written then.
    """
    results.prepare(out)
    paths = find_pictures(frames)
    stamped = _read_odometry(odometry, len(paths))
    poses = planar_rows(stamped)
    ground, shape = _read_ground(camera)
    images = _read_pictures(paths, shape)
    from jaxloc.pipelines import floor_mosaic as pipeline

    default = pipeline.Config()
    config = default if config_path is None else configuration.read_config(config_path, default)
    inputs = {"command": "mosaic", "frames": str(frames), "odometry": str(odometry), "camera": str(camera)}
    with session.output_folder(out):
        motions = relative_poses(poses[:-1], poses[1:])
        try:
            built = pipeline.make_mosaic(images, motions, ground, start=poses[0], config=config)
        except ValueError as error:
            raise DataError(odometry, " ".join(str(error).split())) from None
        if not built.used.any():
            raise DataError(frames, "no image overlaps another: there is nothing to join")
        _write_map(built, out)
        times = np.asarray(stamped.trajectory.times, np.float64) + stamped.start
        _write_path(times, built.poses, out)
        names = tuple(path.name for path in paths)
        metrics = results.write(report.Record(names, times, poses, built), config, out, inputs)
    _announce(metrics, out)
    return 0


def find_pictures(folder: Path) -> list[Path]:
    """Images of a folder, by name.

    Raises:
        DataError: when there is no such folder, or less than two images in it.
    """
    if not folder.is_dir():
        raise DataError(folder, "no such folder")
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in _ENDINGS)
    if len(paths) < 2:
        raise DataError(folder, f"holds {len(paths)} images ({', '.join(_ENDINGS)}); a mosaic needs two or more")
    return paths


def planar_rows(stamped: StampedTrajectory) -> np.ndarray:
    """Poses (x, y, heading) of a trajectory: what it says of the plane."""
    matrices = np.asarray(stamped.trajectory.matrices(), dtype=np.float64)
    return np.column_stack([matrices[:, :2, 3], np.arctan2(matrices[:, 1, 0], matrices[:, 0, 0])])


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
    # Files of cameras that look straight down need not say so.
    pitch = 0.5 * np.pi if record.pitch is None else record.pitch
    ground = GroundCamera(record.camera, height, pitch=pitch, roll=0.0 if record.roll is None else record.roll)
    return ground, record.shape


def _read_pictures(paths: list[Path], shape: tuple[int, int] | None) -> np.ndarray:
    images = []
    for path in paths:
        data = np.fromfile(path, np.uint8)
        image = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE) if data.size else None
        if image is None:
            raise DataError(path, "is no image that can be read")
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
    picture = np.where(np.asarray(mosaic.known), values, 0.0).astype(np.uint8)[::-1]
    write_file(out / "mosaic.png", cv2.imencode(".png", picture)[1].tobytes())
    resolution = float(mosaic.raster.resolution)
    # As in maps of the ROS map server: the corner of the lower left pixel, not its center.
    x, y = np.asarray(mosaic.raster.origin, np.float64) - 0.5 * resolution
    lines = (f"image: mosaic.png\nresolution: {resolution:.9g}", f"origin: [{x:.9g}, {y:.9g}, 0]", "gap: 0", "")
    write_file(out / "mosaic.yaml", "\n".join(lines))


def _write_path(times: np.ndarray, poses: np.ndarray, out: Path) -> None:
    rows = []
    for time, (x, y, heading) in zip(times, poses, strict=True):
        matrix = np.eye(4)
        matrix[:2, :2] = [[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]]
        matrix[:2, 3] = x, y
        rows.append(tum.format_pose(float(time), matrix) + "\n")
    write_file(out / "trajectory.tum", "".join(rows))


def _announce(metrics: dict[str, Any], out: Path) -> None:
    words = [f"{metrics['pictures_used']} of {metrics['images']} images joined"]
    if metrics["left_out"]:
        words.append("left out: " + ", ".join(metrics["left_out"][:5]) + (", ..." * (len(metrics["left_out"]) > 5)))
    words.append(f"{metrics['loop_closures']} loop closures")
    typer.echo(f"{'; '.join(words)}: {out / 'report.html'}")
