"""CARMEN laser logs: one message per line, plain or compressed with gzip or bzip2.

::

    FLASER n r1 ... rn  x y theta  odom_x odom_y odom_theta  time host logger_time
    ROBOTLASER1 kind start fov step max_range accuracy mode  n r1 ... rn  m s1 ... sm  laser_x y theta  robot_x y theta
        tv rv forward side turn  time host logger_time
    PARAM robot_front_laser_max 80.99 ...          the greatest range of FLASER
    VERTEX2 id x y theta                           a corrected pose of the scan that follows (graph-SLAM logs)

All else is skipped. Lines are read one by one, so that memory grows with the scans and not with the file.
"""

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxloc.data.io.errors import DataError
from jaxloc.data.io.text import check_seconds, is_positive, read_lines
from jaxloc.data.laser_log import LaserLog, Mounting, find_mounting

_MOST_BEAMS = 10_000
_MAX_RANGE = 81.0  # of the SICK lasers that these logs come from
_TAIL = 3  # time, host, time of the logger


class _Scan(NamedTuple):
    """A laser line; poses are (x, y, heading), and the vertex is the corrected pose before it."""

    time: float
    ranges: np.ndarray
    laser: tuple[float, ...]
    robot: tuple[float, ...]
    start: float
    step: float
    max_range: float | None
    vertex: tuple[float, ...] | None


def read_log(path: Path | str) -> LaserLog:
    """Reads a log.

    Scans are those of FLASER or of ROBOTLASER1, whichever comes first. A scan that is not later than the one before it
    is left out and counted. FLASER's laser pose gives the mount if it stands still on the robot; if it does not, the
    log has been corrected, and it is kept as that. A laser pose that stays where it is while the robot drives was never
    set (see `laser_log.find_mounting`).

    Args:
        path: the file; its compression is recognized by its content.

    Returns:
        The log.

    Raises:
        DataError: when the file is missing, damaged, malformed or too large, has no laser lines, or time mostly goes
            back.
    """
    path = Path(path)
    rows: list[_Scan] = []
    kind, limit, vertex = None, None, None
    for number, words in read_lines(path):
        name = words[0]
        if name == "PARAM" and len(words) > 2 and words[1] in ("robot_front_laser_max", "laser_front_laser_max"):
            limit = _reach(path, number, words[2])
        elif name == "VERTEX2":
            vertex = tuple(_numbers(path, number, words[2:5], 3))
        elif name in ("FLASER", "ROBOTLASER1") and kind in (None, name):
            kind = name
            row = (_parse_flaser if name == "FLASER" else _parse_robotlaser)(path, number, words, vertex)
            if rows and len(row.ranges) != len(rows[0].ranges):
                beams = len(row.ranges), len(rows[0].ranges)
                raise DataError(path, f"line {number} has {beams[0]} beams, the scans before it {beams[1]}")
            rows.append(row)
            vertex = None
    if not rows:
        raise DataError(path, "has no laser lines (FLASER or ROBOTLASER1)")
    return _make_log(path, rows, limit)


def _make_log(path: Path, rows: list[_Scan], limit: float | None) -> LaserLog:
    times = np.array([row.time for row in rows])
    keep = increasing(path, times)
    kept = [row for row, good in zip(rows, keep, strict=True) if good]
    odometry, lasers = (np.array([getattr(row, name) for row in kept]) for name in ("robot", "laser"))
    mounting = find_mounting(odometry, lasers)
    corrected = lasers if mounting.kind == Mounting.CORRECTED else None
    if all(row.vertex is not None for row in kept):
        corrected = np.array([row.vertex for row in kept])
    first = kept[0]
    return LaserLog(
        name=path.name.split(".")[0],
        times=times[keep],
        ranges=np.stack([row.ranges for row in kept]),
        odometry=odometry,
        angle_min=first.start,
        angle_increment=first.step,
        max_range=first.max_range or limit or _MAX_RANGE,
        mount=mounting.pose,
        corrected=corrected,
        dropped=int((~keep).sum()),
        mounting=mounting.describe(),
    )


def increasing(path: Path, times: np.ndarray) -> np.ndarray:
    """Mask of scans that are later than all scans kept before them.

    Args:
        path: the file, for the error.
        times: s.

    Returns:
        True where kept.

    Raises:
        DataError: when more than half would go.
    """
    check_seconds(path, times)
    keep, last = np.zeros(len(times), bool), -math.inf
    for index, time in enumerate(times):
        keep[index] = time > last
        last = max(time, last)
    if keep.sum() * 2 < len(times):
        raise DataError(path, f"time goes backwards: only {int(keep.sum())} of {len(times)} scans are in order")
    return keep


def _parse_flaser(path: Path, line: int, words: list[str], vertex: tuple[float, ...] | None) -> _Scan:
    count = _count(path, line, words, 1)
    if len(words) < 2 + count + 6 + _TAIL:
        raise DataError(path, f"line {line} is cut short: {count} ranges, two poses and three words must follow")
    poses = _numbers(path, line, words[2 + count : 8 + count], 6)
    # 181 beams reach the other side, 180 end a step before it.
    step = math.pi / max(count - 1 if count % 2 else count, 1)
    time, ranges = _number(path, line, words[8 + count]), _ranges(path, line, words[2 : 2 + count])
    return _Scan(time, ranges, tuple(poses[:3]), tuple(poses[3:]), -0.5 * math.pi, step, None, vertex)


def _parse_robotlaser(path: Path, line: int, words: list[str], vertex: tuple[float, ...] | None) -> _Scan:
    start, _, step, reach = _numbers(path, line, words[2:6], 4)
    count = _count(path, line, words, 8)
    extra = _count(path, line, words, 9 + count, least=0)
    rest = 10 + count + extra
    if len(words) < rest + 11 + _TAIL:
        raise DataError(path, f"line {line} is cut short: 14 words must follow the ranges")
    if not (1e-9 < step < math.pi and is_positive(reach)):
        raise DataError(path, f"line {line}: angular step {step:g} and greatest range {reach:g} must be positive")
    poses = _numbers(path, line, words[rest : rest + 6], 6)
    time, ranges = _number(path, line, words[rest + 11]), _ranges(path, line, words[9 : 9 + count])
    return _Scan(time, ranges, tuple(poses[:3]), tuple(poses[3:]), start, step, reach, vertex)


def _count(path: Path, line: int, words: list[str], place: int, least: int = 1) -> int:
    try:
        count = int(words[place])
    except (IndexError, ValueError):
        raise DataError(path, f"line {line} does not say how many ranges it holds") from None
    if not least <= count <= _MOST_BEAMS:
        raise DataError(path, f"line {line} claims {count} ranges; {least} to {_MOST_BEAMS} can be")
    return count


def _reach(path: Path, line: int, word: str) -> float:
    """A greatest range; some logs have 0 where it was never set."""
    value = _number(path, line, word)
    if value != 0.0 and not is_positive(value):
        raise DataError(path, f"line {line}: greatest range {value:g} must be positive")
    return value


def _ranges(path: Path, line: int, words: list[str]) -> np.ndarray:
    """Ranges; nan and inf are readings that failed."""
    try:
        with np.errstate(over="ignore"):
            return np.fromiter(map(float, words), np.float64, len(words)).astype(np.float32)
    except ValueError:
        raise DataError(path, f"line {line} holds a range that is no number") from None


def _numbers(path: Path, line: int, words: list[str], count: int) -> list[float]:
    if len(words) != count:
        raise DataError(path, f"line {line} is cut short")
    return [_number(path, line, word) for word in words]


def _number(path: Path, line: int, word: str) -> float:
    try:
        value = float(word)
    except ValueError:
        raise DataError(path, f"line {line} holds {word[:20]!r} where a number must be") from None
    if not math.isfinite(value):
        raise DataError(path, f"line {line} holds a number that is not finite")
    if abs(value) > 1e30:
        raise DataError(path, f"line {line} holds {value:g}, too large to compute with")
    return value
