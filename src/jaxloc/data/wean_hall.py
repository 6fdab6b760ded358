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

from jaxloc.data.carmen import increasing
from jaxloc.data.io.errors import DataError
from jaxloc.data.io.text import parse_numbers, read_lines
from jaxloc.data.laser_log import LaserLog, find_mounting
from jaxloc.poses import SE2
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
    rows: list[np.ndarray] = []
    for line, words in read_lines(path):
        numbers = parse_numbers(path, line, words, len(rows[0]) if rows else len(words))
        rows.append(np.array(numbers, dtype=np.float32))
    if not rows:
        raise DataError(path, "is empty")
    free = np.stack(rows).T
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
    lines = ((line, words[1:]) for line, words in read_lines(path) if words[0] == "L")
    rows = [np.array(parse_numbers(path, line, words, 7 + _BEAMS)) for line, words in lines]
    if not rows:
        raise DataError(path, "has no laser lines (L)")
    table = np.stack(rows)
    keep = increasing(path, table[:, -1])
    table = table[keep]
    scale = np.array([0.01, 0.01, 1.0])
    odometry, lasers = table[:, :3] * scale, table[:, 3:6] * scale
    mounting = find_mounting(odometry, lasers)
    return LaserLog(
        name=path.name.split(".")[0],
        times=table[:, -1],
        ranges=(0.01 * table[:, 6:-1]).astype(np.float32),
        odometry=odometry,
        angle_min=-0.5 * math.pi,
        angle_increment=math.pi / _BEAMS,
        max_range=81.9,
        mount=mounting.pose,
        dropped=int((~keep).sum()),
        mounting=mounting.describe(),
    )
