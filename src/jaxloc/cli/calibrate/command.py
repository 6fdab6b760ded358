"""``jaxloc calibrate``: intrinsics of a camera, or of a stereo rig, from images of a chessboard."""

import re
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np
import typer

from jaxloc.cli import lifecycle, session
from jaxloc.cli.calibrate import report
from jaxloc.cli.lifecycle import Arguments
from jaxloc.data import DataError, camera_file
from jaxloc.data.io.files import natural_order
from jaxloc.data.io.images import SUFFIXES, read_gray, read_orientation
from jaxloc.data.io.writing import RowWriter, write_file
from jaxloc.features.opencv.chessboard import board_points, find_chessboard

_MOST_CORNERS = 10_000


class Search(eqx.Module):
    """Corners found in the images of one camera.

    Attributes:
        paths: the images.
        corners: px, or None where the board was not found.
        reasons: why an image was skipped; empty where it was not.
        shape: (rows, columns).
    """

    paths: list[Path]
    corners: list[np.ndarray | None]
    reasons: list[str]
    shape: tuple[int, int]


def default_config() -> Any:
    """The default options."""
    from jaxloc.pipelines import calibration

    return calibration.Config()


def run_images(images: list[Path], right: list[Path] | None, board: tuple[str, float], arguments: Arguments) -> int:
    """Calibrates a camera, or two.

    Args:
        images: images, or folders of them, of the (left) camera.
        right: those of the right camera.
        board: inner corners as "9x6", and the edge of a square, m.
        arguments: output folder and options.

    Returns:
        The exit code.

    Raises:
        DataError: when any input is bad; nothing is written then.
    """
    lifecycle.prepare(arguments.out)
    grid, square = _grid(board[0]), board[1]
    if not (np.isfinite(square) and square > 0.0):
        raise DataError("--square", f"is {square:g}, must be positive: the edge of a square, m")
    config = arguments.read(default_config())
    lists = [list_images(paths) for paths in (images, right) if paths]
    if len({len(paths) for paths in lists}) > 1:
        raise DataError("--right", f"has {len(lists[1])} images, the left camera {len(lists[0])}: they must be pairs")
    inputs = {"command": "calibrate", "images": [str(path) for path in images], "grid": board[0], "square": square}
    inputs["right"] = None if right is None else [str(path) for path in right]
    searches = [search(paths, grid, title) for paths, title in zip(lists, ("boards", "right boards"), strict=False)]
    import jax

    with jax.enable_x64(True), lifecycle.open_run(arguments.out) as run:
        with session.show_progress("calibration", 1) as progress:
            record = _calibrate(searches, board_points(grid, square), config)
            progress(1)
        write_cameras(arguments.out, record.result, searches[0].shape)
        _write_corners(arguments.out / "corners.csv", searches, record.result)
        code = run.finish(record, config, inputs, _summary)
    for line in record.skipped():
        typer.echo(f"skipped {line}", err=True)
    for path in record.turned():
        typer.echo(f"turned {path}: its board was found from the other end", err=True)
    return code


def _calibrate(searches: list[Search], board: np.ndarray, config: Any) -> report.Record:
    from jaxloc.pipelines import calibration

    result = calibration.run(_views(searches, board), config)
    if not result.ok:
        path = searches[0].paths[0]
        raise DataError(path, f"no calibration: {result.status}; take more images, with the board tilted")
    return report.Record(searches, result)


def _summary(metrics: dict[str, Any]) -> str:
    return f"{metrics['boards_used']} boards, rms {metrics['rms_px']:.3f} px"


def list_images(paths: list[Path]) -> list[Path]:
    """Images in natural order (2 before 10), folders in place of what is in them.

    Raises:
        DataError: when a path is not there, or a folder holds no image.
    """
    found: list[Path] = []
    for path in paths:
        if path.is_dir():
            files = (p for p in path.iterdir() if p.suffix.lower() in SUFFIXES and p.is_file())
            inside = sorted(files, key=natural_order)
            if not inside:
                raise DataError(path, "holds no image")
            found += inside
        elif path.is_file():
            found.append(path)
        else:
            raise DataError(path, "no such file")
    return found


def search(paths: list[Path], grid: tuple[int, int], title: str) -> Search:
    """Searches the board in every image; one that cannot be used is skipped, with the reason.

    Raises:
        DataError: when no image can be read.
    """
    _check_orientations(paths)
    common_shape = _common_shape(paths)
    corners: list[np.ndarray | None] = []
    reasons: list[str] = []
    with session.show_progress(title, len(paths)) as progress:
        for number, path in enumerate(paths):
            image = _read(path)
            found, reason = None, ""
            if image is None:
                reason = "cannot be read as an image"
            elif image.shape != common_shape:
                reason = f"is {_size(image.shape)}, the others are {_size(common_shape)}"
            else:
                found = find_chessboard(image, grid)
                reason = "" if found is not None else f"shows no whole board of {grid[0]}x{grid[1]} inner corners"
            corners.append(found)
            reasons.append(reason)
            progress(number + 1)
    return Search(paths, corners, reasons, common_shape)


def write_cameras(out: Path, result: Any, shape: tuple[int, int]) -> None:
    """Writes camera.yaml; of two cameras also right.yaml and stereo.yaml.

    Raises:
        DataError: when a file cannot be written.
    """
    for side, name in zip(result.sides, ("camera.yaml", "right.yaml"), strict=False):
        numbers = side.parameters
        file = camera_file.CameraFile(
            side.camera, shape, names=numbers.names, covariance=np.asarray(numbers.covariance)
        )
        camera_file.write_camera(out / name, file)
    if result.rectification is not None:
        write_file(out / "stereo.yaml", camera_file.format_entries(_stereo_entries(result, shape)))


def _stereo_entries(result: Any, shape: tuple[int, int]) -> dict[str, Any]:
    """Entries as of OpenCV's stereo samples; R and T map points of the left camera to the right one."""
    value, rectified = result.estimate.value, result.rectification
    entries: dict[str, Any] = {"image_width": shape[1], "image_height": shape[0]}
    entries |= camera_file.lens_entries(value.left, "M1", "D1") | camera_file.lens_entries(value.right, "M2", "D2")
    transform = np.linalg.inv(np.asarray(_matrix(value.T_left_right)))
    entries |= {"R": transform[:3, :3], "T": transform[:3, 3:]}
    camera, baseline = rectified.rig.camera, float(rectified.rig.baseline)
    matrix = np.array(camera.matrix())
    first, second = (np.column_stack([matrix, np.zeros(3)]) for _ in range(2))
    second[0, 3] = -matrix[0, 0] * baseline
    rotations = [np.asarray(r.rotation_matrix) for r in (rectified.R_rectified_left, rectified.R_rectified_right)]
    depth = np.array([[1.0, 0.0, 0.0, -matrix[0, 2]], [0.0, 1.0, 0.0, -matrix[1, 2]], [0.0, 0.0, 0.0, matrix[0, 0]]])
    entries |= {"R1": rotations[0], "R2": rotations[1], "P1": first, "P2": second}
    entries["Q"] = np.vstack([depth, [0.0, 0.0, 1.0 / baseline, 0.0]])
    return entries | _stereo_covariance(result)


def _stereo_covariance(result: Any) -> dict[str, Any]:
    """Joint covariance of both cameras' parameters and of ``T_left_right``, in the tangent of that pose."""
    names = [f"{name}_{number}" for number, side in enumerate(result.sides, 1) for name in side.parameters.names]
    names += [f"T_left_right_{name}" for name in result.estimate.value.T_left_right.labels]
    size = len(names)
    return {
        "parameter_names": tuple(names),
        "parameter_covariance": np.asarray(result.estimate.covariance)[:size, :size],
    }


def _matrix(pose: Any) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = np.asarray(pose.rotation.rotation_matrix), np.asarray(pose.translation)
    return matrix


def _write_corners(path: Path, searches: list[Search], result: Any) -> None:
    with RowWriter(path, "camera,image,corner,u,v,error_u,error_v") as rows:
        for side, found, name in zip(result.sides, searches, ("left", "right"), strict=False):
            for image, corners, errors in zip(found.paths, found.corners, side.errors, strict=True):
                for number, (place, error) in enumerate(zip([] if corners is None else corners, errors, strict=False)):
                    numbers = ",".join(f"{value:.4f}" for value in (*place, *error))
                    rows.append(f"{name},{_quoted(image.name)},{number},{numbers}")


def _quoted(name: str) -> str:
    if not set(name) & set(',"\n\r'):
        return name
    doubled = name.replace('"', '""')
    return f'"{doubled}"'


def _views(searches: list[Search], board: np.ndarray) -> tuple[Any, ...]:
    from jaxloc.pipelines import calibration as pipeline

    if len({found.shape for found in searches}) > 1:
        raise DataError("--right", f"images are {_size(searches[1].shape)}, the left ones {_size(searches[0].shape)}")
    views = []
    for found in searches:
        used = np.array([corners is not None for corners in found.corners])
        if not used.any():
            raise DataError(found.paths[0], f"{found.reasons[0]}; none of {len(used)} images can be used")
        empty = np.zeros((len(board), 2))
        stacked = np.stack([empty if corners is None else corners for corners in found.corners])
        views.append(pipeline.Views(board, stacked, used, found.shape))
    if len(views) == 2 and not (views[0].found & views[1].found).any():
        raise DataError("--right", "in no pair is the board seen by both cameras")
    return tuple(views)


def _grid(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d{1,4})[xX×](\d{1,4})", text.strip())
    if match is None:
        raise DataError("--grid", f"is {text!r}, must be like 9x6: inner corners along and down")
    along, down = int(match[1]), int(match[2])
    if min(along, down) < 3 or along * down > _MOST_CORNERS:
        raise DataError(
            "--grid", f"is {text}, must have 3 corners each way at least, and {_MOST_CORNERS} in all at most"
        )
    return along, down


def _read(path: Path) -> np.ndarray | None:
    try:
        return read_gray(path)
    except DataError:
        return None


def _check_orientations(paths: list[Path]) -> None:
    """A lens belongs to the sensor: images that are turned in different ways cannot be of one calibration."""
    ways = {}
    for path in paths:
        try:
            ways.setdefault(read_orientation(path), path)
        except DataError:
            continue  # named where it is read
    if len(ways) > 1:
        (first, path), (second, other) = list(ways.items())[:2]
        what = f"has the EXIF orientation {second}, but {path.name} has {first}: one camera cannot have both"
        raise DataError(other, f"{what}; remove the tags, so that all are as the sensor stores them")


def _common_shape(paths: list[Path]) -> tuple[int, int]:
    """The size that most images have; of equals, the first."""
    shapes = [image.shape for image in map(_read, paths) if image is not None]
    if not shapes:
        raise DataError(paths[0], "cannot be read as an image, nor can any other")
    return max(dict.fromkeys(shapes), key=shapes.count)


def _size(shape: tuple[int, ...]) -> str:
    return f"{shape[1]}x{shape[0]}"
