"""UTIAS MRCLAM: a robot with wheel odometry and a camera among bar-coded landmarks, under motion capture.

References:
    Leung, Halpern, Barfoot, Liu, "The UTIAS multi-robot cooperative localization and mapping dataset", IJRR 2011.
"""

from pathlib import Path

import numpy as np

from jaxloc.data.io.errors import DataError
from jaxloc.data.io.files import is_folder
from jaxloc.data.io.text import check_seconds, read_rows, whole_numbers
from jaxloc.data.landmarks.landmark_log import LandmarkLog, assemble, ranges_and_bearings
from jaxloc.poses.planar import dead_reckon, interpolate_poses


def read_mrclam(folder: Path | str, robot: int, *, truth_start: float | None = None, delay: float = 0.0) -> LandmarkLog:
    """Reads the log of one robot: one step for each landmark it saw.

    Expects ``Barcodes.dat``, ``Landmark_Groundtruth.dat``, ``Robot<i>_Odometry.dat`` and ``Robot<i>_Measurement.dat``,
    and takes the poses of motion capture from ``Robot<i>_Groundtruth.dat`` (time, x, y, theta) or, where their clock is
    known, from ``Robot<i>_groundtruth*_tum.txt``. Each may be packed with gzip (``.gz``). Bar codes of other robots,
    and unknown ones, are left out.

    Args:
        folder: the data set.
        robot: which one, from 1.
        truth_start: stamp at which the TUM file has time zero, s.
        delay: how long after its stamp a velocity takes effect, s. The log holds commands; robot 1 of set 1 follows
            them a quarter of a second later.

    Returns:
        The log; time zero is the first stamp of odometry.

    Raises:
        DataError: when a file is missing or malformed, or nothing was seen.
    """
    folder = Path(folder)
    if not is_folder(folder):
        raise DataError(folder, "no such folder")
    path, table = folder / "Barcodes.dat", _rows(folder / "Barcodes.dat", 2)
    subjects, barcodes = (whole_numbers(path, table[:, i], "subject or bar code").tolist() for i in (0, 1))
    codes = dict(zip(barcodes, subjects, strict=True))
    landmarks = _rows(folder / "Landmark_Groundtruth.dat", 5)
    names = tuple(whole_numbers(folder / "Landmark_Groundtruth.dat", landmarks[:, 0], "landmark").tolist())
    row_of = {name: row for row, name in enumerate(names)}
    odometry = _distinct(_rows(folder / f"Robot{robot}_Odometry.dat", 3))
    seen = _rows(folder / f"Robot{robot}_Measurement.dat", 4)
    if not len(odometry):
        raise DataError(folder, f"robot {robot} has no odometry")
    check_seconds(folder / f"Robot{robot}_Odometry.dat", odometry[:, 0])
    check_seconds(folder / f"Robot{robot}_Measurement.dat", seen[:, 0])
    seen_codes = whole_numbers(folder / f"Robot{robot}_Measurement.dat", seen[:, 1], "bar code").tolist()
    rows = np.array([row_of.get(codes.get(code, 0), -1) for code in seen_codes], dtype=np.int64)
    kept = (rows >= 0) & (seen[:, 0] >= odometry[0, 0])
    if not kept.any():
        raise DataError(folder, f"robot {robot} saw no landmark")
    seen, rows = seen[kept], rows[kept]
    order = np.argsort(seen[:, 0], kind="stable")
    seen, rows = seen[order], rows[order]
    start = float(odometry[0, 0])
    poses = dead_reckon(odometry[:, 0] - start, odometry[:, 1:], seen[:, 0] - start - delay)
    truth = _truth(folder, robot, seen[:, 0], truth_start)
    readings = ranges_and_bearings(seen[:, 2], seen[:, 3], rows)
    return assemble(start, seen[:, 0] - start, poses, readings, (names, landmarks[:, 1:3]), truth)


def _truth(folder: Path, robot: int, at: np.ndarray, truth_start: float | None) -> tuple[np.ndarray, np.ndarray]:
    """True poses (x, y, theta) at some stamps, and where they are known."""
    plain = sorted(folder.glob(f"Robot{robot}_Groundtruth.dat*"))
    if plain:
        table = _distinct(_rows(folder / f"Robot{robot}_Groundtruth.dat", 4))
    else:
        packed = sorted(folder.glob(f"Robot{robot}_groundtruth*_tum.txt*"))
        if not packed or truth_start is None:
            return np.zeros((len(at), 3)), np.zeros(len(at), bool)
        tum = _distinct(_rows(packed[0], 8))
        heading = 2.0 * np.arctan2(tum[:, 6], tum[:, 7])
        table = np.column_stack([tum[:, 0] + truth_start, tum[:, 1], tum[:, 2], heading])
    if not len(table):
        return np.zeros((len(at), 3)), np.zeros(len(at), bool)
    known = (at >= table[0, 0]) & (at <= table[-1, 0])
    return interpolate_poses(table[:, 0], table[:, 1:], at), known


def _distinct(rows: np.ndarray) -> np.ndarray:
    """Rows in the order of their stamps, one for each."""
    return rows[np.unique(rows[:, 0], return_index=True)[1]]


def _rows(path: Path, count: int) -> np.ndarray:
    """A table of numbers, from the file or its gzipped form."""
    packed = path if path.suffix == ".gz" else path.with_name(path.name + ".gz")
    plain = path.suffix != ".gz" and (path.exists() or not packed.exists())
    return read_rows(path if plain else packed, count)
