"""ROS map server files: a YAML file with resolution and origin, and an image.

::

    image: map.pgm            beside the YAML file; its first row is the top
    resolution: 0.05          m a pixel
    origin: [-26, -10, 0]     pose of the lower left corner: x, y (m), heading (rad)
    negate: 0                 1 where white is occupied
    occupied_thresh: 0.65
    free_thresh: 0.196
    mode: trinary             or scale (both: dark is occupied; transparent cells of scale are unknown),
                              or raw (percent, and what is above is unknown)
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float32, Float64, Num

from jaxloc.data.io.errors import DataError
from jaxloc.data.io.images import read_stored
from jaxloc.data.io.offset import choose_offset, subtract_offset
from jaxloc.data.io.text import is_positive
from jaxloc.data.io.writing import write_file
from jaxloc.data.io.yaml_file import describe, read_entries, to_number
from jaxloc.poses import SE2
from jaxloc.sensors import OccupancyMap


def read_map(path: Path | str, *, offset: Sequence[float] | np.ndarray = (0.0, 0.0)) -> OccupancyMap:
    """Reads a map.

    Args:
        path: the YAML file.
        offset: (x, y) to subtract from the origin, m; see `read_offset`.

    Returns:
        The map; its rows grow with y.

    Raises:
        DataError: when a file is missing or malformed, a number cannot be, or the origin is too far from the offset to
            be held to a centimeter.
        ImportError: when pyyaml is not installed.
    """
    path = Path(path)
    entries = read_entries(path, "map")
    resolution = _number(path, "resolution", entries.get("resolution"))
    if not is_positive(resolution):
        raise DataError(path, f"resolution is {resolution:g}, must be positive")
    x, y, heading = _origin(path, entries.get("origin"))
    corner = subtract_offset(path, np.array([[x, y]]), offset)[0]
    occupied = _number(path, "occupied_thresh", entries.get("occupied_thresh", 0.65))
    free = _number(path, "free_thresh", entries.get("free_thresh", 0.196))
    if not 0.0 <= free < occupied <= 1.0:
        raise DataError(path, f"0 <= free_thresh < occupied_thresh <= 1 must hold; they are {free:g} and {occupied:g}")
    probability = _probability(path, entries, occupied, free)
    return OccupancyMap(jnp.asarray(probability), resolution, SE2(*corner, heading), occupied, free)


def read_offset(path: Path | str) -> Float64[np.ndarray, "2"]:
    """Reads what to subtract from coordinates of a map so that JAX's default floating-point type can hold them.

    Args:
        path: the YAML file.

    Returns:
        (x, y), m: zero but for origins beyond 8 km (in single precision), such as those of national grids; then the
        origin, rounded to whole kilometers.

    Raises:
        DataError: when the file is missing or malformed, or has no origin.
        ImportError: when pyyaml is not installed.
    """
    path = Path(path)
    return choose_offset(np.array([_origin(path, read_entries(path, "map").get("origin"))[:2]]))


def write_map(path: Path | str, grid: OccupancyMap, *, offset: Sequence[float] | np.ndarray = (0.0, 0.0)) -> None:
    """Writes a map as a YAML file and, beside it, a PGM image: black is occupied, white free, gray unknown.

    Args:
        path: the YAML file to be.
        grid: the map.
        offset: (x, y) of the frame of the map in that of the file, m.

    Raises:
        DataError: when a file cannot be written.
    """
    path = Path(path)
    values = np.full(grid.probability.shape, 205, np.uint8)
    values[np.asarray(grid.occupied)], values[np.asarray(grid.free)] = 0, 254
    rows, columns = grid.probability.shape
    image = path.with_suffix(".pgm")
    write_file(image, b"P5\n%d %d\n255\n" % (columns, rows) + values[::-1].tobytes())
    x, y = (float(value) + float(moved) for value, moved in zip((grid.origin.x, grid.origin.y), offset, strict=True))
    lines = (
        f"image: {image.name}",
        f"resolution: {float(grid.resolution):.7g}",
        f"origin: [{x:.10g}, {y:.10g}, {float(grid.origin.theta):.7g}]",
        "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n",
    )
    write_file(path, "\n".join(lines))


def _number(path: Path, name: str, value: Any) -> float:
    number = to_number(value)
    if number is None or not abs(number) < 1e30:
        raise DataError(path, f"{name} is {describe(value)}, must be a finite number")
    return number


def _origin(path: Path, value: Any) -> list[float]:
    if not isinstance(value, list) or len(value) not in (2, 3):
        raise DataError(path, f"origin is {describe(value)}, must be [x, y, heading]")
    numbers = [_number(path, "origin", item) for item in value]
    return numbers if len(numbers) == 3 else [*numbers, 0.0]


def _negate(path: Path, value: Any) -> bool:
    if isinstance(value, bool):
        return value
    if to_number(value) not in (0.0, 1.0):
        raise DataError(path, f"negate is {describe(value)}, must be 0 or 1")
    return to_number(value) == 1.0


def _probability(path: Path, entries: dict[str, Any], occupied: float, free: float) -> Float32[np.ndarray, "h w"]:
    """As nav2's map server computes it (``map_io.cpp``, ``loadMapFromFile``)."""
    name, mode = entries.get("image"), entries.get("mode", "trinary")
    if not isinstance(name, str) or not name:
        raise DataError(path, "has no image")
    if mode not in ("trinary", "scale", "raw"):
        raise DataError(path, f"mode is {describe(mode)}, must be trinary, scale or raw")
    negate = _negate(path, entries.get("negate", 0))
    image = read_stored(path.parent / name)[::-1]
    white = float(np.iinfo(image.dtype).max)
    has_opacity, unknown = image.shape[2] == 4, np.float32(0.5 * (occupied + free))
    # Trinary maps count opacity as one more color, to which old maps owe their look.
    shade = _mean(image if mode == "trinary" else image[..., :3] if has_opacity else image)
    shade /= white
    if mode == "raw":
        percent = np.rint(255.0 * shade, out=shade)
        return np.where(percent <= 100.0, percent / np.float32(100.0), unknown)
    if not negate:
        np.subtract(1.0, shade, out=shade)
    if mode == "scale" and has_opacity:
        shade[image[..., 3] < white] = unknown
    return shade


def _mean(image: Num[np.ndarray, "h w c"]) -> Float32[np.ndarray, "h w"]:
    total = image[..., 0].astype(np.float32)
    for channel in range(1, image.shape[2]):
        total += image[..., channel]
    total /= np.float32(image.shape[2])
    return total
