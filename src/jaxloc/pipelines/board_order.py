"""Order of the corners of a chessboard in the two images of a stereo pair.

A board with an even (or odd) number of corners both ways looks the same after half a turn, a square one after a quarter
turn. The detector begins at the end that is higher in the image, which may be one end in the left and the other end in
the right image. Only one of the orders gives the pair the relative pose that the other pairs have.
"""

import numpy as np
from jaxtyping import Bool, Float64, Int64

from jaxloc.features.opencv.backend import load

_TIE = 1e-6  # prefers the order as it is
_FAR = 0.5  # rad, or share of the distance: a pair that disagrees by more counts as this
_MOST_REFERENCES = 40


def find_orders(
    board: Float64[np.ndarray, "m 3"],
    left: Float64[np.ndarray, "n m 2"],
    right: Float64[np.ndarray, "n m 2"],
    both: Bool[np.ndarray, " n"],
    shape: tuple[int, int],
) -> Int64[np.ndarray, "n m"]:
    """Finds for each pair the order in which the corners of the right image agree with those of the left one.

    Each camera is calibrated roughly by itself. For each order of each pair follows a relative pose of the cameras; the
    one that the most pairs come close to in one of their orders wins.

    Args:
        board: corners in the frame of the board, m, row by row.
        left: their pixels in the left images.
        right: their pixels in the right images.
        both: pairs in which both cameras see the board.
        shape: (rows, columns) of the images.

    Returns:
        Indices into the corners of each right image.
    """
    orders, pairs = _symmetries(board), np.flatnonzero(both)
    found = np.tile(np.arange(len(board)), (len(left), 1))
    if len(orders) < 2 or len(pairs) < 2:
        return found
    views = [_board_poses(board, corners[pairs], shape) for corners in (left, right)]
    if views[0] is None or views[1] is None:
        return found
    turns = np.stack([_motion(board[order], board) for order in orders])
    # Corner i of the image is corner order[i] of the board: the board has been moved within its plane.
    relative = np.einsum("nij,kjl,nlm->nkim", views[0], turns, np.linalg.inv(views[1]))
    scale = float(np.median(np.linalg.norm(views[0][:, :3, 3], axis=1)))
    best, chosen = np.inf, np.zeros(len(pairs), int)
    for reference in relative[:_MOST_REFERENCES].reshape(-1, 4, 4):
        gaps = np.minimum(_distances(relative, reference, scale), _FAR) + _TIE * (np.arange(len(orders)) > 0)
        total = gaps.min(axis=1).sum()
        if total < best - _TIE:
            best, chosen = total, gaps.argmin(axis=1)
    for pair, kind in zip(pairs, chosen, strict=True):
        # The right image's corner i lies where the left image's corner order[i] does.
        found[pair] = np.argsort(orders[kind])
    return found


def _symmetries(board: Float64[np.ndarray, "m 3"]) -> list[np.ndarray]:
    """Orders of the corners of turned boards that look the same, that as it is first."""
    rows, columns = len(np.unique(board[:, 1].round(9))), len(np.unique(board[:, 0].round(9)))
    if rows * columns != len(board) or (rows + columns) % 2:
        return [np.arange(len(board))]
    grid = np.arange(len(board)).reshape(rows, columns)
    turns = range(4) if rows == columns else (0, 2)
    return [np.rot90(grid, turn).ravel() for turn in turns]


def _motion(moved: Float64[np.ndarray, "m 3"], board: Float64[np.ndarray, "m 3"]) -> Float64[np.ndarray, "4 4"]:
    """The motion within the plane that takes the board to its turned copy."""
    centers = moved.mean(axis=0), board.mean(axis=0)
    product = (moved - centers[0])[:, :2].T @ (board - centers[1])[:, :2]
    angle = np.arctan2(product[1, 0] - product[0, 1], product[0, 0] + product[1, 1])
    motion = np.eye(4)
    motion[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    motion[:3, 3] = centers[0] - motion[:3, :3] @ centers[1]
    return motion


def _board_poses(board: np.ndarray, corners: np.ndarray, shape: tuple[int, int]) -> np.ndarray | None:
    """``T_camera_board`` of each image by a rough calibration; None where there is none."""
    cv2 = load()
    points = [board.astype(np.float32)] * len(corners)
    pixels = [np.ascontiguousarray(one, np.float32)[:, None] for one in corners]
    flags = cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
    try:
        _, _, _, rotations, translations = cv2.calibrateCamera(points, pixels, shape[::-1], None, None, flags=flags)
    except cv2.error:
        return None
    poses = np.tile(np.eye(4), (len(corners), 1, 1))
    poses[:, :3, :3] = [cv2.Rodrigues(rotation)[0] for rotation in rotations]
    poses[:, :3, 3] = np.reshape(translations, (-1, 3))
    return poses if np.isfinite(poses).all() else None


def _distances(poses: np.ndarray, reference: np.ndarray, scale: float) -> np.ndarray:
    """Angle (rad) and distance (in units of the scale) of poses from another, added."""
    cosine = 0.5 * (np.einsum("...ij,ij->...", poses[..., :3, :3], reference[:3, :3]) - 1.0)
    gaps = np.linalg.norm(poses[..., :3, 3] - reference[:3, 3], axis=-1)
    return np.arccos(np.clip(cosine, -1.0, 1.0)) + gaps / scale
