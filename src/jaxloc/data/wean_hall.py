"""CMU Wean Hall maps and laser logs, text formats of a well-known particle filter exercise.

::

    map:  a row of numbers a line, cells of 10 cm: probability of being free, -1 unknown; row = x, column = y
    log:  O x y theta time
          L x y theta  x_laser y_laser theta_laser  r1 ... r180  time
"""

import math
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from jaxloc.data.carmen import increasing, read_lines
from jaxloc.data.io.errors import DataError
from jaxloc.data.io.text import parse_numbers
from jaxloc.data.laser_log import LaserLog
from jaxloc.poses import SE2
from jaxloc.poses.planar import relative_poses
from jaxloc.sensors import OccupancyMap

_CELL = 0.1
_BEAMS = 180
_UNKNOWN = 0.5


def read_map(path: Path | str, *, resolution: float = _CELL) -> OccupancyMap:
    """Reads a map.

    Args:
        path: the text file, plain or compressed.
        resolution: edge of a cell, m.

    Returns:
        The map, x to the right.

    Raises:
        DataError: when the file is missing or malformed.
    """
    path = Path(path)
    rows: list[list[float]] = []
    for line, words in read_lines(path):
        rows.append(parse_numbers(path, line, words, len(rows[0]) if rows else len(words)))
    if not rows:
        raise DataError(path, "is empty")
    free = np.array(rows, dtype=np.float32).T
    probability = np.where(free < 0.0, _UNKNOWN, 1.0 - free)
    if probability.min() < 0.0 or probability.max() > 1.0:
        raise DataError(path, "holds numbers that are neither -1 nor probabilities")
    return OccupancyMap(jnp.asarray(probability, jnp.float32), resolution, SE2(0.0, 0.0, 0.0))


def read_log(path: Path | str) -> LaserLog:
    """Reads the scans of a log.

    Args:
        path: the text file, plain or compressed.

    Returns:
        The log, in m; a scan sweeps from -90 to 89 degrees.

    Raises:
        DataError: when the file is missing, malformed, or has no scan.
    """
    path = Path(path)
    rows = [parse_numbers(path, line, words[1:], 7 + _BEAMS) for line, words in read_lines(path) if words[0] == "L"]
    if not rows:
        raise DataError(path, "has no laser lines (L)")
    table = np.array(rows)
    keep = increasing(path, table[:, -1])
    table = table[keep]
    scale = np.array([0.01, 0.01, 1.0])
    odometry, lasers = table[:, :3] * scale, table[:, 3:6] * scale
    mount = np.median(relative_poses(odometry, lasers), axis=0)
    return LaserLog(
        name=path.name.split(".")[0],
        times=table[:, -1],
        ranges=(0.01 * table[:, 6:-1]).astype(np.float32),
        odometry=odometry,
        angle_min=-0.5 * math.pi,
        angle_increment=math.pi / _BEAMS,
        max_range=81.9,
        mount=tuple(float(value) for value in mount),
        dropped=int((~keep).sum()),
    )
