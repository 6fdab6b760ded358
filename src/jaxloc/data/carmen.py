"""CARMEN laser logs: one message per line, plain or compressed with gzip or bzip2.

::

    FLASER n r1 ... rn  x y theta  odom_x odom_y odom_theta  time host logger_time
    ROBOTLASER1 kind start fov step max_range accuracy mode  n r1 ... rn  m s1 ... sm  laser_x y theta  robot_x y theta
        tv rv forward side turn  time host logger_time
    PARAM robot_front_laser_max 80.99 ...          the greatest range of FLASER
    VERTEX2 id x y theta                           a corrected pose of the scan that follows (graph-SLAM logs)

All else is skipped. Lines are read one by one, so that memory grows with the scans and not with the file.
"""

import bz2
import gzip
import math
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from jaxloc.data.io.errors import DataError
from jaxloc.data.laser_log import LaserLog
from jaxloc.poses.planar import relative_poses

_LONGEST_LINE = 1 << 20
_LARGEST_LOG = 1 << 31  # bytes after decompression
_MOST_BEAMS = 10_000
_MAX_RANGE = 81.0  # of the SICK lasers that these logs come from
_TAIL = 3  # time, host, time of the logger


def read_log(path: Path | str) -> LaserLog:
    """Reads a log.

    Scans are those of FLASER or of ROBOTLASER1, whichever comes first. A scan that is not later than the one before it
    is left out and counted. FLASER's laser pose gives the mount if it stands still on the robot; if it does not, the
    log has been corrected, and it is kept as that.

    Args:
        path: the file; its compression is recognized by its content.

    Returns:
        The log.

    Raises:
        DataError: when the file is missing, damaged, malformed or too large, has no laser lines, or time mostly goes
            back.
    """
    path = Path(path)
    rows, kind, limit, vertex = [], None, None, None
    for number, words in read_lines(path):
        name = words[0]
        if name == "PARAM" and len(words) > 2 and words[1] in ("robot_front_laser_max", "laser_front_laser_max"):
            limit = _number(path, number, words[2])
        elif name == "VERTEX2":
            vertex = np.array(_numbers(path, number, words[2:5], 3))
        elif name in ("FLASER", "ROBOTLASER1") and kind in (None, name):
            kind = name
            row = (_parse_flaser if name == "FLASER" else _parse_robotlaser)(path, number, words)
            if rows and len(row["ranges"]) != len(rows[0]["ranges"]):
                raise DataError(
                    path, f"line {number} has {len(row['ranges'])} beams, the scans before it {len(rows[0]['ranges'])}"
                )
            rows.append(row | {"vertex": vertex})
            vertex = None
    if not rows:
        raise DataError(path, "has no laser lines (FLASER or ROBOTLASER1)")
    return _make_log(path, rows, limit)


def _make_log(path: Path, rows: list[dict[str, Any]], limit: float | None) -> LaserLog:
    keep = increasing(path, np.array([row["time"] for row in rows]))
    kept = [row for row, good in zip(rows, keep, strict=True) if good]
    odometry, lasers = (np.stack([row[name] for row in kept]) for name in ("robot", "laser"))
    mounts = relative_poses(odometry, lasers)
    mount = np.median(mounts, axis=0)
    rigid = bool(np.percentile(np.abs(mounts - mount), 99) < 0.05)
    vertices = [row["vertex"] for row in kept]
    corrected = None if rigid else lasers
    if all(vertex is not None for vertex in vertices):
        corrected = np.stack(vertices)
    first = kept[0]
    return LaserLog(
        name=path.name.split(".")[0],
        times=np.array([row["time"] for row in kept]),
        ranges=np.stack([row["ranges"] for row in kept]),
        odometry=odometry,
        angle_min=first["start"],
        angle_increment=first["step"],
        max_range=first["max_range"] or limit or _MAX_RANGE,
        mount=tuple(float(value) for value in mount) if rigid else (0.0, 0.0, 0.0),
        corrected=corrected,
        dropped=int((~keep).sum()),
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
    keep, last = np.zeros(len(times), bool), -math.inf
    for index, time in enumerate(times):
        keep[index] = time > last
        last = max(time, last)
    if keep.sum() * 2 < len(times):
        raise DataError(path, f"time goes backwards: only {int(keep.sum())} of {len(times)} scans are in order")
    return keep


def _parse_flaser(path: Path, line: int, words: list[str]) -> dict[str, Any]:
    count = _count(path, line, words, 1)
    if len(words) < 2 + count + 6 + _TAIL:
        raise DataError(path, f"line {line} is cut short: {count} ranges, two poses and three words must follow")
    poses = _numbers(path, line, words[2 + count : 8 + count], 6)
    step = math.pi / (count - 1 if count % 2 else count)  # 181 beams reach the other side, 180 end a step before it
    return {
        "time": _number(path, line, words[8 + count]),
        "ranges": _ranges(path, line, words[2 : 2 + count]),
        "laser": np.array(poses[:3]),
        "robot": np.array(poses[3:]),
        "start": -0.5 * math.pi,
        "step": step,
        "max_range": None,
    }


def _parse_robotlaser(path: Path, line: int, words: list[str]) -> dict[str, Any]:
    start, _, step, reach = _numbers(path, line, words[2:6], 4)
    count = _count(path, line, words, 8)
    extra = _count(path, line, words, 9 + count, least=0)
    rest = 10 + count + extra
    if len(words) < rest + 11 + _TAIL:
        raise DataError(path, f"line {line} is cut short: 14 words must follow the ranges")
    if not (0.0 < step < math.pi and reach > 0.0):
        raise DataError(path, f"line {line}: angular step {step:g} and greatest range {reach:g} must be positive")
    poses = _numbers(path, line, words[rest : rest + 6], 6)
    return {
        "time": _number(path, line, words[rest + 11]),
        "ranges": _ranges(path, line, words[9 : 9 + count]),
        "laser": np.array(poses[:3]),
        "robot": np.array(poses[3:]),
        "start": start,
        "step": step,
        "max_range": reach,
    }


def read_lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Reads a text file that may be compressed, line by line, with limits on what a small hostile file can do.

    Args:
        path: the file.

    Yields:
        The number and the words of each line that is neither empty nor a comment.

    Raises:
        DataError: when it is missing, damaged or too large.
    """
    total, number = 0, 0
    try:
        with _open_text(path) as file:
            while line := file.readline(_LONGEST_LINE):
                number, total = number + 1, total + len(line)
                if len(line) == _LONGEST_LINE:
                    raise DataError(path, f"line {number} is longer than {_LONGEST_LINE} bytes")
                if total > _LARGEST_LOG:
                    raise DataError(path, f"is larger than {_LARGEST_LOG >> 20} MiB")
                words = line.decode("utf-8", "replace").split()
                if words and not words[0].startswith("#"):
                    yield number, words
    except (OSError, EOFError, zlib.error) as error:
        if isinstance(error, FileNotFoundError):
            raise DataError(path, "no such file") from error
        what = error.strerror if isinstance(error, OSError) and error.strerror else "damaged or truncated"
        raise DataError(path, f"cannot be read: {what}") from error


def _open_text(path: Path) -> Any:
    """Opens a file that may be compressed, by the first bytes that it has."""
    with path.open("rb") as file:
        magic = file.read(3)
    if magic[:2] == b"\x1f\x8b":
        return gzip.open(path, "rb")
    return bz2.open(path, "rb") if magic == b"BZh" else path.open("rb")


def _count(path: Path, line: int, words: list[str], place: int, least: int = 1) -> int:
    try:
        count = int(words[place])
    except (IndexError, ValueError):
        raise DataError(path, f"line {line} does not say how many ranges it holds") from None
    if not least <= count <= _MOST_BEAMS:
        raise DataError(path, f"line {line} claims {count} ranges; {least} to {_MOST_BEAMS} can be")
    return count


def _ranges(path: Path, line: int, words: list[str]) -> np.ndarray:
    """Ranges; nan and inf are readings that failed."""
    try:
        return np.array(words, dtype=np.float64).astype(np.float32)
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
    return value
