"""Factor lists with known correspondences, such as Victoria Park: ``ODOMETRY`` and ``LANDMARK`` lines.

References:
    Guivant and Nebot, "Optimization of the simultaneous localization and map-building algorithm", IEEE T-RA 2001.
"""

from pathlib import Path

import numpy as np

from jaxloc.data.io.errors import DataError
from jaxloc.data.io.text import parse_numbers, read_text, whole_numbers
from jaxloc.data.landmarks.landmark_log import LandmarkLog, assemble, ranges_and_bearings
from jaxloc.poses.planar import compose_poses

_NUMBERS = {"ODOMETRY": 11, "LANDMARK": 7}


def read_factors(path: Path | str) -> LandmarkLog:
    """Reads a list of ``ODOMETRY i j dx dy dtheta cov(6)`` and ``LANDMARK pose landmark x y cov(3)`` lines.

    Args:
        path: the file.

    Returns:
        The log, a step for each landmark seen; times count poses, since the file has no stamps. True positions
        and poses are unknown.

    Raises:
        DataError: when the file is missing or malformed, poses do not follow each other, or nothing was seen.
    """
    steps, seen = [], []
    for number, line in enumerate(read_text(path).split("\n"), start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if words[0] not in _NUMBERS:
            raise DataError(path, f"line {number} begins with {words[0][:20]!r}, needs ODOMETRY or LANDMARK")
        values = parse_numbers(path, number, words[1:], _NUMBERS[words[0]])
        (steps if words[0] == "ODOMETRY" else seen).append(values)
    if not steps or not seen:
        raise DataError(path, "has no ODOMETRY or no LANDMARK lines")
    odometry, sightings = np.array(steps), np.array(seen)
    for column, what in ((odometry[:, 0], "pose"), (odometry[:, 1], "pose"), (sightings[:, 1], "landmark")):
        whole_numbers(path, column, what)
    count = len(odometry) + 1
    names = np.r_[odometry[:1, 0], odometry[:, 1]]
    if (names[:-1] != odometry[:, 0]).any() or (np.diff(names) <= 0).any():
        raise DataError(path, "ODOMETRY lines must each begin at the pose that the line before led to")
    index = np.clip(np.searchsorted(names, sightings[:, 0]), 0, count - 1)
    if (names[index] != sightings[:, 0]).any():
        raise DataError(path, "a LANDMARK line names a pose that no ODOMETRY line leads to")
    poses = np.zeros((count, 3))
    for i, step in enumerate(odometry[:, 2:5]):
        poses[i + 1] = compose_poses(poses[i : i + 1], step[None])[0]
    order = np.argsort(index, kind="stable")
    return _log(poses, index[order], sightings[order])


def _log(poses: np.ndarray, index: np.ndarray, sightings: np.ndarray) -> LandmarkLog:
    names, rows = np.unique(sightings[:, 1].astype(np.int64), return_inverse=True)
    x, y = sightings[:, 2:4].T
    readings = ranges_and_bearings(np.hypot(x, y), np.arctan2(y, x), rows)
    unknown = np.zeros((len(index), 3)), np.zeros(len(index), bool)
    landmarks = tuple(int(name) for name in names), np.full((len(names), 2), np.nan)
    return assemble(0.0, index.astype(float), poses[index], readings, landmarks, unknown)
