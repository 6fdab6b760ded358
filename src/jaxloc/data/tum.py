"""TUM trajectory files: ``time x y z qx qy qz qw``, one pose per line."""

from collections.abc import Sequence
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64

from jaxloc.data.io.errors import DataError
from jaxloc.data.io.offset import choose_offset, subtract_offset
from jaxloc.data.io.text import check_increasing, read_rows
from jaxloc.data.io.writing import write_file
from jaxloc.poses import Trajectory


class StampedTrajectory(eqx.Module):
    """Trajectory with the origin of its times and positions in double precision.

    Args:
        start: the stamp of time zero, s.
        trajectory: the path; times in s since ``start``, positions relative to ``offset``.
        offset: (x, y, z) of the trajectory's frame in the frame of the file, of the same axes, m.
    """

    start: float = eqx.field(static=True)
    trajectory: Trajectory
    offset: tuple[float, float, float] = eqx.field(static=True, default=(0.0, 0.0, 0.0))


def read_trajectory(
    path: Path | str, *, start: float | None = None, offset: Sequence[float] | None = None
) -> StampedTrajectory:
    """Reads a trajectory.

    Args:
        path: the file; lines that begin with ``#`` are comments.
        start: the stamp of time zero, s; the first stamp of the file where not given. Files that are to be compared
            must be read with the same.
        offset: (x, y, z) to subtract from positions, m. Where not given it is zero, but whole kilometers near the first
            position where the floating-point type cannot hold the coordinates to a millimeter (single precision: beyond
            8 km, as of UTM). Files that are to be compared must be read with the same.

    Returns:
        The path, its start and its offset.

    Raises:
        DataError: when the file is missing or malformed, has no poses, times do not increase, or positions are too far
            from the offset to be held to a centimeter.
    """
    rows = read_rows(path, 8)
    if not len(rows):
        raise DataError(path, "has no poses")
    check_increasing(path, rows[:, 0])
    norms = np.linalg.norm(rows[:, 4:], axis=1)
    wrong = np.flatnonzero(np.abs(norms - 1.0) > 0.01)
    if wrong.size:
        raise DataError(path, f"row {wrong[0] + 1}: the quaternion has length {norms[wrong[0]]:.3g}, must be 1")
    start = float(rows[0, 0]) if start is None else start
    matrices = np.tile(np.eye(4), (len(rows), 1, 1))
    matrices[:, :3, :3] = _rotations(rows[:, 4:] / norms[:, None])
    moved = choose_offset(rows[:, 1:4]) if offset is None else np.asarray(offset, np.float64)
    matrices[:, :3, 3] = subtract_offset(path, rows[:, 1:4], moved)
    trajectory = Trajectory.from_matrices(jnp.asarray(rows[:, 0] - start), jnp.asarray(matrices))
    return StampedTrajectory(start, trajectory, (float(moved[0]), float(moved[1]), float(moved[2])))


def _rotations(quaternions: Float64[np.ndarray, "n 4"]) -> Float64[np.ndarray, "n 3 3"]:
    """Rotation matrices of unit quaternions (x, y, z, w)."""
    vector, w = quaternions[:, :3], quaternions[:, 3, None, None]
    x, y, z = vector.T
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
    return np.eye(3) + 2.0 * w * cross + 2.0 * cross @ cross


def _quaternion(rotation: Float64[np.ndarray, "3 3"]) -> Float64[np.ndarray, " 4"]:
    """The unit quaternion (x, y, z, w >= 0) of a rotation: the leading eigenvector of Bar-Itzhack's 4x4 matrix."""
    skew = np.array([rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]])
    matrix = np.empty((4, 4))
    matrix[:3, :3] = rotation + rotation.T - np.trace(rotation) * np.eye(3)
    matrix[:3, 3] = matrix[3, :3] = skew
    matrix[3, 3] = np.trace(rotation)
    quaternion = np.linalg.eigh(matrix)[1][:, -1]
    return -quaternion if quaternion[3] < 0 else quaternion


def format_pose(time: float, matrix: np.ndarray) -> str:
    """Writes a stamped pose as a TUM row.

    Args:
        time: s.
        matrix: the pose, 4x4.

    Returns:
        8 numbers, without the line end.

    Example:
        >>> format_pose(0.5, np.eye(4))
        '0.500000 0.000000000 0.000000000 0.000000000 0.000000000 0.000000000 0.000000000 1.000000000'
    """
    matrix = np.asarray(matrix, dtype=np.float64)
    # Adding zero turns a negative zero into zero.
    values = np.concatenate([matrix[:3, 3], _quaternion(matrix[:3, :3])]) + 0.0
    return " ".join([f"{time:.6f}", *(f"{value:.9f}" for value in values)])


def write_trajectory(
    path: Path | str, trajectory: Trajectory, *, start: float = 0.0, offset: Sequence[float] = (0.0, 0.0, 0.0)
) -> None:
    """Writes a trajectory, in one step.

    Args:
        path: the file.
        trajectory: the path.
        start: the stamp of time zero, s.
        offset: (x, y, z) of the trajectory's frame in the frame of the file, m.

    Raises:
        DataError: when the file cannot be written.
    """
    times = np.asarray(trajectory.times, dtype=np.float64) + start
    matrices = np.array(trajectory.matrices(), dtype=np.float64)
    matrices[:, :3, 3] += np.asarray(offset, np.float64)
    rows = (format_pose(float(time), matrix) for time, matrix in zip(times, matrices, strict=True))
    write_file(path, "".join(row + "\n" for row in rows))


def planar_poses(stamped: StampedTrajectory) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, "n 3"]]:
    """Stamps and planar poses (x, y, heading) of a trajectory as in its file, in double precision.

    Args:
        stamped: a trajectory; its heights, rolls and pitches are ignored.
    """
    matrices = np.asarray(stamped.trajectory.matrices(), dtype=np.float64)
    times = np.asarray(stamped.trajectory.times, dtype=np.float64) + stamped.start
    heading = np.arctan2(matrices[:, 1, 0], matrices[:, 0, 0])
    return times, np.column_stack([matrices[:, :2, 3] + np.asarray(stamped.offset[:2]), heading])
