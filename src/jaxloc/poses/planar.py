"""Planar poses (x, y, heading) as rows of NumPy arrays, for readers and simulators on the host."""

import numpy as np
from jaxtyping import Float64

from jaxloc._arguments import checked


@checked
def relative_poses(before: Float64[np.ndarray, "n 3"], after: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
    """Relative poses (x, y, heading): ``T_a^-1 T_b``, headings in [-pi, pi).

    Args:
        before: poses (x, y, heading), m and rad.
        after: poses in the same frame.

    Returns:
        Each pose of ``after`` in the frame of that of ``before``.

    Example:
        >>> relative_poses(np.array([[1.0, 0.0, np.pi / 2]]), np.array([[1.0, 2.0, np.pi / 2]])).round(3).tolist()
        [[2.0, 0.0, 0.0]]
    """
    shift = after[:, :2] - before[:, :2]
    cos, sin = np.cos(before[:, 2]), np.sin(before[:, 2])
    turn = (after[:, 2] - before[:, 2] + np.pi) % (2.0 * np.pi) - np.pi
    return np.stack([cos * shift[:, 0] + sin * shift[:, 1], cos * shift[:, 1] - sin * shift[:, 0], turn], axis=1)


@checked
def compose_poses(first: Float64[np.ndarray, "n 3"], then: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
    """Compositions ``T_a T_b`` of poses and motions, the inverse of `relative_poses`.

    Args:
        first: poses (x, y, heading), m and rad.
        then: motions, in the frames of ``first``.

    Returns:
        Poses; headings are not wrapped.

    Example:
        >>> compose_poses(np.array([[1.0, 0.0, np.pi / 2]]), np.array([[2.0, 0.0, 0.0]])).round(3).tolist()
        [[1.0, 2.0, 1.571]]
    """
    cos, sin = np.cos(first[:, 2]), np.sin(first[:, 2])
    x = first[:, 0] + cos * then[:, 0] - sin * then[:, 1]
    y = first[:, 1] + sin * then[:, 0] + cos * then[:, 1]
    return np.stack([x, y, first[:, 2] + then[:, 2]], axis=1)


@checked
def dead_reckon(
    times: Float64[np.ndarray, " n"], twists: Float64[np.ndarray, "n 2"], at: Float64[np.ndarray, " t"]
) -> Float64[np.ndarray, "t 3"]:
    """Dead reckoning: poses from piecewise constant velocities, exact on each arc.

    Args:
        times: of the velocities, s, increasing.
        twists: forward velocity (m/s) and turn rate (rad/s).
        at: times of the poses, s; the robot stands still before the first velocity.

    Returns:
        (x, y, theta), relative to the pose at the first time.
    """
    headings = np.r_[0.0, np.cumsum(twists[:-1, 1] * np.diff(times))]
    arcs = _arc(headings[:-1], twists[:-1], np.diff(times))
    nodes = np.column_stack([np.vstack([np.zeros((1, 2)), np.cumsum(arcs, axis=0)]), headings])
    row = np.clip(np.searchsorted(times, at, side="right") - 1, 0, len(times) - 1)
    since = np.maximum(at - times[row], 0.0)
    rest = np.column_stack([_arc(nodes[row, 2], twists[row], since), twists[row, 1] * since])
    return nodes[row] + rest


def _arc(headings: np.ndarray, twists: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """Displacements along arcs of constant velocity."""
    turn = twists[:, 1] * seconds
    chord = twists[:, 0] * seconds * np.sinc(turn / (2.0 * np.pi))
    middle = headings + 0.5 * turn
    return np.stack([chord * np.cos(middle), chord * np.sin(middle)], axis=1)


@checked
def interpolate_poses(
    times: Float64[np.ndarray, " n"], poses: Float64[np.ndarray, "n 3"], at: Float64[np.ndarray, " t"]
) -> Float64[np.ndarray, "t 3"]:
    """Linear interpolation of planar poses in time, of headings along the shorter arc."""
    headings = np.unwrap(poses[:, 2])
    return np.stack([np.interp(at, times, column) for column in (*poses[:, :2].T, headings)], axis=1)


@checked
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
