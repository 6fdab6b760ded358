"""Pose covariances as CSV rows: ``frame`` and the 36 numbers of the 6x6 matrix.

The tangent is the right perturbation ``T exp(d)`` with ``d = (tx, ty, tz, rx, ry, rz)``: translation first, in the
camera frame, m and rad. The two header lines say so.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float64

from jaxloc.data.io.errors import DataError
from jaxloc.data.io.text import parse_numbers, read_text

_AXES = ("tx", "ty", "tz", "rx", "ry", "rz")
HEADER = (
    "# covariance of T_world_camera; right perturbation T exp(d), d = (tx, ty, tz, rx, ry, rz), m and rad\n"
    + ",".join(["frame", *(f"{row}_{column}" for row in _AXES for column in _AXES)])
)


def format_covariance(frame: int, covariance: np.ndarray) -> str:
    """Writes a covariance as a row.

    Args:
        frame: the number of the frame.
        covariance: 6x6.

    Returns:
        37 numbers separated by commas, without the line end.

    Example:
        >>> format_covariance(3, np.eye(6)).split(",")[:3]
        ['3', '1.000000e+00', '0.000000e+00']
    """
    return ",".join([str(frame), *(f"{value:.6e}" for value in np.asarray(covariance, dtype=np.float64).ravel())])


def read_covariances(path: Path | str) -> Float64[np.ndarray, "n 6 6"]:
    """Reads the file that the rows of :func:`format_covariance` make up.

    Args:
        path: the file.

    Returns:
        The matrices, in the order of the rows.

    Raises:
        DataError: when the file is missing or malformed.
    """
    lines = [(number, line) for number, line in enumerate(read_text(path).split("\n"), start=1) if line.strip()]
    lines = [(number, line) for number, line in lines if not line.startswith("#")]
    if not lines or not lines[0][1].startswith("frame,"):
        raise DataError(path, "has no header: its first column must be named frame")
    rows = [parse_numbers(path, number, line.split(","), 37)[1:] for number, line in lines[1:]]
    return np.array(rows, dtype=np.float64).reshape(-1, 6, 6)
