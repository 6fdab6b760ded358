"""Range-only recordings of a robotic mower among radio beacons: ``Plaza1_DR.txt``, ``Plaza1_TD.txt``, ``Plaza1_.mat``.

References:
    Djugash, Hamner, Roth, "Navigating with ranging radios: five data sets with ground truth", JFR 2009.
"""

import io
import math
from pathlib import Path

import numpy as np

from jaxloc.data.io.errors import DataError
from jaxloc.data.io.files import read_bytes
from jaxloc.data.io.text import check_increasing, check_seconds, read_rows, whole_numbers
from jaxloc.data.landmarks.landmark_log import LandmarkLog, assemble, ranges
from jaxloc.poses.planar import interpolate_poses

_TABLES = ("GT", "TL")
_KINDS = frozenset({"double", "single", *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64))})
_MOST_NUMBERS = 4_000_000
_UNRELATED_TRUTH = 1.0  # s without truth beyond which interpolating it means nothing


def read_ranging(folder: Path | str, name: str) -> LandmarkLog:
    """Reads one recording: a step for each range.

    Args:
        folder: where the files are.
        name: what they begin with, such as ``Plaza1``.

    Returns:
        The log. True poses and the surveyed beacons come from the ``.mat`` file; without it the beacons are nan and no
        truth is valid.

    Raises:
        DataError: when a file is missing or malformed.
    """
    folder = Path(folder)
    path = folder / f"{name}_DR.txt"
    odometry = read_rows(path, 3)
    check_increasing(path, odometry[:, 0])
    seen = read_rows(folder / f"{name}_TD.txt", 4)
    if not len(odometry) or not len(seen):
        raise DataError(folder, f"{name} has no odometry or no ranges")
    check_seconds(folder / f"{name}_TD.txt", seen[:, 0])
    seen = seen[np.argsort(seen[:, 0], kind="stable")]
    seen = seen[(seen[:, 0] >= odometry[0, 0]) & (seen[:, 0] <= odometry[-1, 0])]
    if not len(seen):
        raise DataError(folder, f"{name} has no range during its odometry")
    names = tuple(np.unique(whole_numbers(folder / f"{name}_TD.txt", seen[:, 2], "beacon")).tolist())
    beacons, truth = _survey(folder / f"{name}_.mat", names, seen[:, 0])
    start = float(odometry[0, 0])
    poses = interpolate_poses(odometry[:, 0] - start, _integrate(odometry[:, 1:]), seen[:, 0] - start)
    rows = np.searchsorted(names, seen[:, 2])
    return assemble(start, seen[:, 0] - start, poses, ranges(seen[:, 3], rows), (names, beacons), truth)


def _integrate(steps: np.ndarray) -> np.ndarray:
    """Poses after steps of (distance, turn), each along its arc."""
    headings = np.cumsum(steps[:, 1])
    middle = headings - 0.5 * steps[:, 1]
    chord = steps[:, 0] * np.sinc(steps[:, 1] / (2.0 * np.pi))
    return np.column_stack([np.cumsum(chord * np.cos(middle)), np.cumsum(chord * np.sin(middle)), headings])


def _survey(path: Path, names: tuple[int, ...], at: np.ndarray) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Positions of the beacons, and true poses at some stamps with where they are known."""
    beacons = np.full((len(names), 2), np.nan)
    if not path.exists():
        return beacons, (np.zeros((len(at), 3)), np.zeros(len(at), bool))
    truth, surveyed = _read_tables(path)
    if truth.ndim != 2 or truth.shape[1] != 4 or surveyed.ndim != 2 or surveyed.shape[1] != 3 or len(truth) < 2:
        raise DataError(path, f"GT must be n x 4 and TL k x 3; they are {truth.shape} and {surveyed.shape}")
    for table in (truth, surveyed):
        if not (np.abs(table) < 1e30).all():
            raise DataError(path, "holds a number that is not finite")
    check_increasing(path, truth[:, 0])
    for beacon, (x, y) in zip(whole_numbers(path, surveyed[:, 0], "beacon").tolist(), surveyed[:, 1:], strict=True):
        if beacon in names:
            beacons[names.index(beacon)] = x, y
    nearest = np.clip(np.searchsorted(truth[:, 0], at), 1, len(truth) - 1)
    known = (at >= truth[0, 0]) & (at <= truth[-1, 0])
    known &= truth[nearest, 0] - truth[nearest - 1, 0] < _UNRELATED_TRUTH
    return beacons, (interpolate_poses(truth[:, 0], truth[:, 1:], at), known)


def _read_tables(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """The tables GT and TL of a MATLAB file."""
    from scipy.io import loadmat, whosmat  # SciPy comes with jax

    data = read_bytes(path)
    try:
        # Sizes first: packed tables can be a thousand times as large as the file.
        for name, shape, kind in whosmat(io.BytesIO(data)):
            if name in _TABLES and (kind not in _KINDS or math.prod(shape) > _MOST_NUMBERS):
                raise DataError(path, f"table {name} is {kind} of {shape}: needs at most {_MOST_NUMBERS} numbers")
        tables = loadmat(io.BytesIO(data), variable_names=_TABLES)
        truth, surveyed = (np.asarray(tables[name], dtype=float) for name in _TABLES)
    except DataError:
        raise
    except Exception as error:  # the reader raises many kinds for damaged files
        raise DataError(path, f"cannot be read as a MATLAB file with tables GT and TL: {error}") from error
    return truth, surveyed
