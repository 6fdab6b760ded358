"""Camera files in OpenCV's YAML format, with height and mounting angles of a ground robot.

::

    %YAML:1.0
    ---
    image_width: 1280
    image_height: 720
    camera_matrix: !!opencv-matrix           3x3; or M1 of a stereo rig
    distortion_coefficients: !!opencv-matrix 4, 5 or 8 (k1 k2 p1 p2 k3 k4 k5 k6), or 12 or 14 that end in
                                             zeros; or D1 of a stereo rig
    distortion_model: fisheye                where the lens is one: 4 coefficients
    height_m: 1.2                            of the camera over the ground; positive pitch looks down, positive roll
    pitch_rad: 0.02                          turns the right side of the camera down
    roll_rad: 0.
    parameter_names: [ fx, fy, cx, cy ]      and `parameter_covariance`, in their order and units

Files of ROS (``camera_info``) have the same names and are read too.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float64

from jaxloc.data.io.errors import DataError
from jaxloc.data.io.text import is_positive
from jaxloc.data.io.writing import write_file
from jaxloc.data.io.yaml_file import describe, read_entries, to_number, to_whole
from jaxloc.sensors import BrownConrady, KannalaBrandt, Pinhole

_MATRIX_KEYS = ("camera_matrix", "M1", "M")
_LENS_KEYS = ("distortion_coefficients", "D1", "D")
_FISHEYE = ("fisheye", "equidistant", "kannala_brandt")
_BROWN = ("plumb_bob", "rational_polynomial", "brown_conrady", "radtan")
_MOST_PIXELS = 1_000_000
_LENS_NAMES = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_UNSUPPORTED = ("s1", "s2", "s3", "s4", "tau_x", "tau_y")


class CameraFile(eqx.Module):
    """Contents of a camera file.

    Attributes:
        camera: focal lengths, principal point and lens.
        shape: (rows, columns) of its images; None where the file does not say.
        height: over the ground, m.
        pitch: rad, positive looks down.
        roll: rad, positive when the right side of the camera is turned down.
        names: of the parameters whose covariance is known, as ``fx`` or ``k1``.
        covariance: of those parameters, in the units of the file.
        path: where it was read.
    """

    camera: Pinhole
    shape: tuple[int, int] | None = eqx.field(static=True, default=None)
    height: float | None = eqx.field(static=True, default=None)
    pitch: float | None = eqx.field(static=True, default=None)
    roll: float | None = eqx.field(static=True, default=None)
    names: tuple[str, ...] = eqx.field(static=True, default=())
    covariance: Float64[np.ndarray, "d d"] | None = None
    path: Path = eqx.field(static=True, default=Path("camera.yaml"))

    def require_height(self) -> float:
        """The height over the ground, m.

        Raises:
            DataError: when the file does not give it.
        """
        if self.height is None:
            raise DataError(self.path, "has no height_m: add the height of the camera over the ground, m")
        return self.height

    def require_shape(self) -> tuple[int, int]:
        """Rows and columns of the images.

        Raises:
            DataError: when the file does not give them.
        """
        if self.shape is None:
            raise DataError(self.path, "has no image_width and image_height: add the size of the images, px")
        return self.shape

    def sigmas(self) -> dict[str, float]:
        """Standard deviations of the parameters by name; empty where they are not known."""
        if self.covariance is None:
            return {}
        roots = np.sqrt(np.maximum(np.diagonal(self.covariance), 0.0))
        return {name: float(root) for name, root in zip(self.names, roots, strict=True)}


def read_camera(path: Path | str) -> CameraFile:
    """Reads a camera.

    Args:
        path: the YAML file.

    Returns:
        The camera; its numbers have JAX's default precision.

    Raises:
        DataError: when the file is missing or malformed, a key is missing (it is named), or a number cannot be.
        ImportError: when pyyaml is not installed.
    """
    path = Path(path)
    entries = read_entries(path, "camera file")
    matrix = _array(path, entries, _MATRIX_KEYS)
    if matrix is None:
        raise DataError(path, f"has no {_MATRIX_KEYS[0]}: it must be a camera file of OpenCV's calibration")
    names, covariance = _covariance(path, entries)
    height = _number(path, entries, "height_m")
    if height is not None and not is_positive(height):
        raise DataError(path, f"height_m is {height:g}, must be positive")
    return CameraFile(
        camera=_camera(path, entries, matrix),
        shape=_shape(path, entries),
        height=height,
        pitch=_angle(path, entries, "pitch_rad"),
        roll=_angle(path, entries, "roll_rad"),
        names=names,
        covariance=covariance,
        path=path,
    )


def write_camera(path: Path | str, file: CameraFile) -> None:
    """Writes a camera as a file that OpenCV's ``FileStorage`` reads as well.

    Args:
        path: the YAML file to be.
        file: the camera and what is known about it.

    Raises:
        DataError: when the file cannot be written.
    """
    entries: dict[str, Any] = {}
    if file.shape is not None:
        entries |= {"image_width": file.shape[1], "image_height": file.shape[0]}
    entries |= lens_entries(file.camera, _MATRIX_KEYS[0], _LENS_KEYS[0])
    entries |= {"height_m": file.height, "pitch_rad": file.pitch, "roll_rad": file.roll}
    if file.covariance is not None:
        entries |= {"parameter_names": file.names, "parameter_covariance": file.covariance}
    write_file(path, format_entries(entries))


def lens_entries(camera: Pinhole, matrix: str, coefficients: str) -> dict[str, Any]:
    """Entries of a camera's matrix and lens under these keys; no lens is five zeros, as OpenCV has it."""
    fx, fy, cx, cy, skew = (float(v) for v in (camera.fx, camera.fy, camera.cx, camera.cy, camera.skew))
    entries: dict[str, Any] = {matrix: np.array([[fx, skew, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])}
    if isinstance(camera.lens, KannalaBrandt):
        entries["distortion_model"] = _FISHEYE[0]
    values = np.zeros(5) if camera.lens is None else np.asarray(_coefficients(camera.lens), np.float64)
    return entries | {coefficients: values[:, None]}


def lens_names(camera: Pinhole) -> tuple[str, ...]:
    """Names of the coefficients of a camera's lens, in their order."""
    if camera.lens is None:
        return ()
    if isinstance(camera.lens, KannalaBrandt):
        return ("k1", "k2", "k3", "k4")
    return _LENS_NAMES[: len(np.asarray(_coefficients(camera.lens)))]


def format_entries(entries: Mapping[str, Any]) -> str:
    r"""Entries as YAML of OpenCV: arrays become ``!!opencv-matrix``; entries that are None are left out.

    Example:
        >>> print(format_entries({"width": 2, "R": np.eye(2)}))
        %YAML:1.0
        ---
        width: 2
        R: !!opencv-matrix
           rows: 2
           cols: 2
           dt: d
           data: [ 1.0, 0.0,
               0.0, 1.0 ]
        <BLANKLINE>
    """
    lines = ["%YAML:1.0", "---"]
    for key, value in entries.items():
        if isinstance(value, np.ndarray):
            rows = [", ".join(repr(float(number)) for number in row) for row in np.atleast_2d(value)]
            lines += [f"{key}: !!opencv-matrix", f"   rows: {len(rows)}", f"   cols: {np.atleast_2d(value).shape[1]}"]
            lines += ["   dt: d", "   data: [ " + ",\n       ".join(rows) + " ]"]
        elif isinstance(value, str):
            lines.append(f"{key}: {value}")
        elif isinstance(value, Sequence):
            lines.append(f"{key}: [ {', '.join(str(item) for item in value)} ]")
        elif value is not None:
            lines.append(f"{key}: {value if isinstance(value, int) else repr(float(value))}")
    return "\n".join(lines) + "\n"


def _coefficients(lens: Any) -> Any:
    return lens.coefficients


def _array(path: Path, entries: dict[str, Any], keys: tuple[str, ...]) -> Float64[np.ndarray, "r c"] | None:
    """The matrix under the first of the keys that is there."""
    key = next((key for key in keys if entries.get(key) is not None), None)
    if key is None:
        return None
    value = entries[key]
    if isinstance(value, list):
        value = {"rows": 1, "cols": len(value), "data": value}
    if not isinstance(value, dict) or not {"rows", "cols", "data"} <= value.keys():
        raise DataError(path, f"{key} is no matrix: it must have rows, cols and data")
    rows, columns, data = to_whole(value["rows"]) or 0, to_whole(value["cols"]) or 0, value["data"]
    if min(rows, columns) < 1 or not isinstance(data, list) or rows * columns != len(data):
        count, sizes = len(data) if isinstance(data, list) else 0, (describe(value["rows"]), describe(value["cols"]))
        raise DataError(path, f"{key} has {count} numbers, but rows: {sizes[0]} and cols: {sizes[1]}")
    numbers = [to_number(number) for number in data]
    if None in numbers:
        raise DataError(path, f"{key} holds something that is no number")
    array = np.array(numbers, dtype=np.float64)
    if not (np.abs(array) < 1e30).all():
        raise DataError(path, f"{key} holds a number that is not finite")
    return array.reshape(rows, columns)


def _camera(path: Path, entries: dict[str, Any], matrix: np.ndarray) -> Pinhole:
    if matrix.shape != (3, 3):
        raise DataError(path, f"camera_matrix is {matrix.shape[0]}x{matrix.shape[1]}, must be 3x3")
    fx, fy = float(matrix[0, 0]), float(matrix[1, 1])
    if not (is_positive(fx) and is_positive(fy)):
        raise DataError(path, f"camera_matrix has focal lengths {fx:g} and {fy:g}, must be positive")
    if matrix[2].tolist() != [0.0, 0.0, 1.0] or matrix[1, 0] != 0.0:
        raise DataError(path, "camera_matrix must have the rows (fx skew cx), (0 fy cy), (0 0 1)")
    return Pinhole(fx, fy, float(matrix[0, 2]), float(matrix[1, 2]), float(matrix[0, 1]), _lens(path, entries))


def _lens(path: Path, entries: dict[str, Any]) -> BrownConrady | KannalaBrandt | None:
    values = _array(path, entries, _LENS_KEYS)
    if values is None:
        raise DataError(path, f"has no {_LENS_KEYS[0]}: without a lens, give five zeros")
    model = entries.get("distortion_model", _FISHEYE[0] if entries.get("fisheye_model") == 1 else _BROWN[0])
    if model not in (*_FISHEYE, *_BROWN):
        raise DataError(path, f"distortion_model is {describe(model)}, must be {_FISHEYE[0]} or {_BROWN[0]}")
    fisheye = model in _FISHEYE
    allowed = (4,) if fisheye else (4, 5, 8, 12, 14)
    if 1 not in values.shape or values.size not in allowed:
        counts = " or ".join(str(count) for count in allowed)
        shape = f"{values.shape[0]}x{values.shape[1]}"
        raise DataError(path, f"distortion_coefficients is {shape}, must be a row or column of {counts} numbers")
    coefficients = tuple(values.ravel().tolist())
    if any(coefficients[8:]):
        name, value = next(pair for pair in zip(_UNSUPPORTED, coefficients[8:], strict=False) if pair[1])
        raise DataError(path, f"has a lens with {name} = {value:g}: thin prisms and tilted sensors are not supported")
    coefficients = coefficients[:8]
    if fisheye:
        return KannalaBrandt(coefficients)
    return BrownConrady(coefficients) if any(coefficients) else None


def _shape(path: Path, entries: dict[str, Any]) -> tuple[int, int] | None:
    sizes = [entries.get(key) for key in ("image_height", "image_width")]
    if sizes == [None, None]:
        return None
    for key, size in zip(("image_height", "image_width"), sizes, strict=True):
        if not 0 < (to_whole(size) or 0) <= _MOST_PIXELS:
            raise DataError(path, f"{key} is {describe(size)}, must be a positive whole number")
    return to_whole(sizes[0]) or 0, to_whole(sizes[1]) or 0


def _number(path: Path, entries: dict[str, Any], key: str) -> float | None:
    value = entries.get(key)
    if value is None:
        return None
    number = to_number(value)
    if number is None or not abs(number) < 1e30:
        raise DataError(path, f"{key} is {describe(value)}, must be a finite number")
    return number


def _angle(path: Path, entries: dict[str, Any], key: str) -> float | None:
    value = _number(path, entries, key)
    if value is not None and abs(value) > math.pi:
        raise DataError(path, f"{key} is {value:g}, must lie between -pi and pi: it is in rad")
    return value


def _covariance(path: Path, entries: dict[str, Any]) -> tuple[tuple[str, ...], np.ndarray | None]:
    covariance, names = _array(path, entries, ("parameter_covariance",)), entries.get("parameter_names")
    if covariance is None:
        return (), None
    if not isinstance(names, list) or covariance.shape != (len(names), len(names)):
        shape = f"{covariance.shape[0]}x{covariance.shape[1]}"
        raise DataError(path, f"parameter_covariance is {shape}, but parameter_names must name every row")
    if not all(isinstance(name, str) for name in names):
        raise DataError(path, "parameter_names must be words")
    return tuple(names), covariance
