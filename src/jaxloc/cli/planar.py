"""Planar poses (x, y, heading) as matrices and back, for files of spatial poses."""

import numpy as np
from jaxtyping import Float64

from jaxloc.data.tum import StampedTrajectory


def planar_matrix(pose: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "4 4"]:
    """The spatial pose of a planar one, at height zero.

    Args:
        pose: (x, y, heading), m and rad.
    """
    x, y, heading = pose
    matrix = np.eye(4)
    matrix[:2, :2] = [[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]]
    matrix[:2, 3] = x, y
    return matrix


def planar_poses(stamped: StampedTrajectory) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, "n 3"]]:
    """Absolute stamps and planar poses (x, y, heading) of a trajectory.

    Args:
        stamped: a trajectory; its heights, rolls and pitches are ignored.
    """
    matrices = np.asarray(stamped.trajectory.matrices(), dtype=np.float64)
    times = np.asarray(stamped.trajectory.times, dtype=np.float64) + stamped.start
    heading = np.arctan2(matrices[:, 1, 0], matrices[:, 0, 0])
    return times, np.column_stack([matrices[:, :2, 3], heading])
