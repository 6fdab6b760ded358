"""Range-only recordings of a robotic mower among radio beacons: ``Plaza1_DR.txt``, ``Plaza1_TD.txt``, ``Plaza1_.mat``.

References:
    Djugash, Hamner, Roth, "Navigating with ranging radios: five data sets with ground truth", JFR 2009.
"""

from pathlib import Path

import numpy as np

from jaxloc.data.io.errors import DataError
from jaxloc.data.io.text import check_increasing, read_rows
from jaxloc.data.landmarks.landmark_log import LandmarkLog, assemble, ranges
from jaxloc.poses.planar import interpolate_poses

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
    seen = seen[np.argsort(seen[:, 0], kind="stable")]
    seen = seen[(seen[:, 0] >= odometry[0, 0]) & (seen[:, 0] <= odometry[-1, 0])]
    if not len(seen):
        raise DataError(folder, f"{name} has no range during its odometry")
    names = tuple(int(beacon) for beacon in np.unique(seen[:, 2]))
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
    from scipy.io import loadmat  # SciPy comes with jax

    try:
        tables = loadmat(path, variable_names=["GT", "TL"])
        truth, surveyed = np.asarray(tables["GT"], dtype=float), np.asarray(tables["TL"], dtype=float)
    except Exception as error:  # the reader raises many kinds for damaged files
        raise DataError(path, f"cannot be read as a MATLAB file with tables GT and TL: {error}") from error
    if truth.ndim != 2 or truth.shape[1] != 4 or surveyed.ndim != 2 or surveyed.shape[1] != 3 or len(truth) < 2:
        raise DataError(path, f"GT must be n x 4 and TL k x 3; they are {truth.shape} and {surveyed.shape}")
    check_increasing(path, truth[:, 0])
    for beacon, x, y in surveyed:
        if int(beacon) in names:
            beacons[names.index(int(beacon))] = x, y
    nearest = np.clip(np.searchsorted(truth[:, 0], at), 1, len(truth) - 1)
    known = (at >= truth[0, 0]) & (at <= truth[-1, 0])
    known &= truth[nearest, 0] - truth[nearest - 1, 0] < _UNRELATED_TRUTH
    return beacons, (interpolate_poses(truth[:, 0], truth[:, 1:], at), known)
