"""ROS map server files: a YAML file with resolution and origin, and an image.

::

    image: map.pgm            beside the YAML file; its first row is the top
    resolution: 0.05          m a pixel
    origin: [-26, -10, 0]     pose of the lower left corner: x, y (m), heading (rad)
    negate: 0                 1 where white is occupied
    occupied_thresh: 0.65
    free_thresh: 0.196
    mode: trinary             or scale (both: dark is occupied), or raw (percent, and what is above is unknown)
"""

import math
from pathlib import Path
from typing import Any

import cv2
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float32

from jaxloc.data.io.errors import DataError
from jaxloc.data.io.text import read_text
from jaxloc.data.io.writing import write_file
from jaxloc.poses import SE2
from jaxloc.sensors import OccupancyMap

_MOST_CELLS = 100_000_000
_UNKNOWN = 0.5


def read_map(path: Path | str) -> OccupancyMap:
    """Reads a map.

    Args:
        path: the YAML file.

    Returns:
        The map; its rows grow with y.

    Raises:
        DataError: when a file is missing or malformed, or a number cannot be.
        ImportError: when pyyaml is not installed.
    """
    path = Path(path)
    entries = _read_yaml(path)
    resolution = _number(path, "resolution", entries.get("resolution"))
    if resolution <= 0.0:
        raise DataError(path, f"resolution is {resolution:g}, must be positive")
    origin = _origin(path, entries.get("origin"))
    occupied = _number(path, "occupied_thresh", entries.get("occupied_thresh", 0.65))
    free = _number(path, "free_thresh", entries.get("free_thresh", 0.196))
    if not 0.0 <= free < occupied <= 1.0:
        raise DataError(path, f"0 <= free_thresh < occupied_thresh <= 1 must hold; they are {free:g} and {occupied:g}")
    probability = _probability(path, entries, occupied, free)
    return OccupancyMap(jnp.asarray(probability), resolution, SE2(*origin), occupied, free)


def write_map(path: Path | str, grid: OccupancyMap) -> None:
    """Writes a map as a YAML file and, beside it, a PGM image: black is occupied, white free, gray unknown.

    Args:
        path: the YAML file to be.
        grid: the map.

    Raises:
        DataError: when a file cannot be written.
    """
    path = Path(path)
    values = np.full(grid.probability.shape, 205, np.uint8)
    values[np.asarray(grid.occupied)], values[np.asarray(grid.free)] = 0, 254
    rows, columns = grid.probability.shape
    image = path.with_suffix(".pgm")
    write_file(image, b"P5\n%d %d\n255\n" % (columns, rows) + values[::-1].tobytes())
    x, y, theta = (float(value) for value in (grid.origin.x, grid.origin.y, grid.origin.theta))
    lines = (
        f"image: {image.name}",
        f"resolution: {float(grid.resolution):.7g}",
        f"origin: [{x:.7g}, {y:.7g}, {theta:.7g}]",
        "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n",
    )
    write_file(path, "\n".join(lines))


def _read_yaml(path: Path) -> dict[str, Any]:
    try:
        import yaml
    except ImportError as error:
        raise ImportError('maps need pyyaml: pip install "jaxloc[cli]"') from error
    try:
        entries = yaml.safe_load(read_text(path))
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        if isinstance(error, DataError):
            raise
        raise DataError(path, f"no valid YAML: {' '.join(str(error).split())[:200]}") from None
    if not isinstance(entries, dict):
        raise DataError(path, "is no map: it must hold image, resolution and origin")
    return entries


def _number(path: Path, name: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise DataError(path, f"{name} is {value!r}, must be a finite number")
    return float(value)


def _origin(path: Path, value: Any) -> list[float]:
    if not isinstance(value, list) or len(value) not in (2, 3):
        raise DataError(path, f"origin is {value!r}, must be [x, y, heading]")
    numbers = [_number(path, "origin", item) for item in value]
    return numbers if len(numbers) == 3 else [*numbers, 0.0]


def _probability(path: Path, entries: dict[str, Any], occupied: float, free: float) -> Float32[np.ndarray, "h w"]:
    name, mode = entries.get("image"), entries.get("mode", "trinary")
    if not isinstance(name, str) or not name:
        raise DataError(path, "has no image")
    if mode not in ("trinary", "scale", "raw"):
        raise DataError(path, f"mode is {mode!r}, must be trinary, scale or raw")
    if entries.get("negate", 0) not in (0, 1):
        raise DataError(path, f"negate is {entries['negate']!r}, must be 0 or 1")
    values = _read_image(path.parent / name)
    if mode == "raw":
        return np.where(values <= 100.0, values / 100.0, 0.5 * (occupied + free)).astype(np.float32)
    share = values / 255.0
    return (share if entries.get("negate", 0) else 1.0 - share).astype(np.float32)


def _read_image(path: Path) -> Float32[np.ndarray, "h w"]:
    """Gray values 0 to 255, the lowest row first."""
    if not path.is_file():
        raise DataError(path, "no such image")
    try:
        image = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
    except (cv2.error, OSError):
        image = None
    if image is None or image.dtype != np.uint8:
        raise DataError(path, "is no image of 8 bits that can be read")
    if image.size > 4 * _MOST_CELLS or not image.size:
        raise DataError(path, f"has {image.size} values, a map has 1 to {_MOST_CELLS}")
    gray = image if image.ndim == 2 else image[:, :, :3].mean(axis=2)
    return np.ascontiguousarray(gray[::-1], dtype=np.float32)
