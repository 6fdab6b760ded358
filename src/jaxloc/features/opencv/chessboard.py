"""Detection of the inner corners of a chessboard, by OpenCV on the host."""

import numpy as np
from jaxtyping import Array, Float64, Num

from jaxloc.features.opencv.backend import load, to_uint8

_WINDOW_RATIO = 0.4  # half-width of the window over the distance of neighboring corners
_LEAST, _MOST = 2, 11  # half-width of the window, px


def find_chessboard(image: Num[np.ndarray | Array, "h w"], grid: tuple[int, int]) -> Float64[np.ndarray, "m 2"] | None:
    """Finds all inner corners of a chessboard with subpixel accuracy.

    Each corner is refined so that the gradients in a window are orthogonal to the lines to the corner; the window is
    so small that it contains no other corner.

    Args:
        image: Grayscale image: uint8, or other types as gray levels 0-255 (0-1 if no value exceeds 1).
        grid: Inner corners along the rows of the board, and down: `(9, 6)` for 10 by 7 squares.

    Returns:
        Pixels (u, v), row by row of the board; None when the board is not completely visible.

    Raises:
        ValueError: The grid has less than 3 corners in a direction.

    References:
        Foerstner and Guelch, "A fast operator for detection and precise location of distinct points", 1987.

    Example:
        >>> import numpy as np
        >>> squares = np.indices((4, 5)).sum(axis=0) % 2
        >>> image = np.pad(np.kron(255 * squares, np.ones((20, 20))), 20, constant_values=255)
        >>> corners = find_chessboard(image, (4, 3))
        >>> corners.shape, bool(np.allclose(np.sort(corners[:, 1])[0], 39.5, atol=0.1))
        ((12, 2), True)
        >>> find_chessboard(np.zeros((60, 80), np.uint8), (4, 3)) is None
        True
    """
    if min(grid) < 3:
        raise ValueError(f"The board has {grid[0]}x{grid[1]} inner corners; at least 3 each way can be found.")
    cv2, pixels = load(), to_uint8(image)
    if min(pixels.shape) < 4 * min(grid):
        return None
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    found, rough = cv2.findChessboardCorners(pixels, grid, flags=flags)
    if not found or rough is None or len(rough) != grid[0] * grid[1]:
        return None
    spacing = _spacing(rough.reshape(grid[1], grid[0], 2))
    half = int(np.clip(_WINDOW_RATIO * spacing, _LEAST, _MOST))
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-4)
    fine = cv2.cornerSubPix(pixels, rough.copy(), (half, half), (-1, -1), stop)
    moved = np.linalg.norm(fine - rough, axis=-1)
    if not np.isfinite(fine).all() or moved.max() > max(0.5 * spacing, 1.0):
        return None
    return fine.reshape(-1, 2).astype(np.float64)


def board_points(grid: tuple[int, int], square: float) -> Float64[np.ndarray, "m 3"]:
    """Inner corners in the frame of the board: x along its rows, y down, z = 0; in the order of `find_chessboard`.

    Args:
        grid: Inner corners along the rows of the board, and down.
        square: Edge of a square, m.

    Returns:
        Points, m.

    Example:
        >>> board_points((3, 3), 0.5)[4].tolist()
        [0.5, 0.5, 0.0]
    """
    rows, columns = np.indices((grid[1], grid[0])).astype(np.float64)
    return square * np.stack([columns.ravel(), rows.ravel(), np.zeros(rows.size)], axis=1)


def _spacing(corners: np.ndarray) -> float:
    """The smallest distance of neighbors, px."""
    along, down = np.diff(corners, axis=1), np.diff(corners, axis=0)
    return float(min(np.linalg.norm(step, axis=-1).min() for step in (along, down)))
