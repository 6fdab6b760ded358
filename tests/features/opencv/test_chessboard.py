"""Chessboards: rendered ones with known corners, seen at an angle; what is none; grids that cannot be."""

import cv2
import numpy as np
import pytest

from jaxloc.features.opencv.chessboard import board_points, find_chessboard

GRID = (7, 5)


def render(homography, shape=(360, 480), oversample=4):
    """A board whose inner corners lie at the integers (1..7, 1..5) of its plane, box-filtered from a fine grid."""
    fine = np.indices((shape[0] * oversample, shape[1] * oversample))[::-1].astype(float)
    u, v = (fine + 0.5) / oversample - 0.5
    x, y, w = np.einsum("ij,jhw->ihw", np.linalg.inv(homography), np.stack([u, v, np.ones_like(u)]))
    x, y = x / w, y / w
    inside = (x > 0) & (x < GRID[0] + 1) & (y > 0) & (y < GRID[1] + 1)
    dark = inside & ((np.floor(x) + np.floor(y)) % 2 == 0)
    image = np.where(dark, 30.0, 220.0).reshape(shape[0], oversample, shape[1], oversample).mean(axis=(1, 3))
    return cv2.GaussianBlur(image, (0, 0), 0.8)


def corners_of(homography):
    plane = board_points(GRID, 1.0)[:, :2] + 1.0
    found = np.column_stack([plane, np.ones(len(plane))]) @ homography.T
    return found[:, :2] / found[:, 2:]


def nearest(found, truth):
    """Distances of found corners to the true ones in the best of the two orders that a board can be read in."""
    return min(np.linalg.norm(order - truth, axis=1).max() for order in (found, found[::-1]))


@pytest.mark.parametrize("scale", [40.0, 14.0])
def test_known_corners(rng, scale):
    homography = np.array([[scale, 0.2 * scale, 40.3], [-0.1 * scale, scale, 70.7], [2e-3, 4e-3, 1.0]])
    image = np.rint(render(homography) + rng.normal(0.0, 1.0, (360, 480))).clip(0, 255).astype(np.uint8)
    found = find_chessboard(image, GRID)
    assert found is not None and found.shape == (35, 2) and found.dtype == np.float64
    assert nearest(found, corners_of(homography)) < 0.15
    again = find_chessboard(image.astype(np.float32), GRID)
    np.testing.assert_array_equal(found, again)


def test_what_is_no_board(rng):
    image = render(np.array([[40.0, 0.0, 40.0], [0.0, 40.0, 70.0], [0.0, 0.0, 1.0]]))
    assert find_chessboard(image, (8, 5)) is None
    assert find_chessboard(image[:, :200], GRID) is None
    assert find_chessboard(np.zeros((50, 50), np.uint8), GRID) is None
    assert find_chessboard(np.zeros((3, 500), np.uint8), GRID) is None
    assert find_chessboard(np.full((50, 50), np.nan, np.float32), GRID) is None
    assert find_chessboard(rng.integers(0, 255, (120, 160), dtype=np.uint8), GRID) is None
    with pytest.raises(ValueError, match="at least 3"):
        find_chessboard(image, (2, 5))


def test_board_points():
    points = board_points((4, 3), 0.1)
    assert points.shape == (12, 3) and points[-1] == pytest.approx([0.3, 0.2, 0.0])
    assert points[1] == pytest.approx([0.1, 0.0, 0.0])


@pytest.mark.recordings
def test_real_boards(recordings):
    folder = recordings / "lanes_carnd_advanced" / "camera_cal"
    names = [f"calibration{i}.jpg" for i in (2, 3, 6)]
    found = [find_chessboard(cv2.imread(str(folder / name), cv2.IMREAD_GRAYSCALE), (9, 6)) for name in names]
    assert all(corners is not None for corners in found)
    assert find_chessboard(cv2.imread(str(folder / "calibration1.jpg"), cv2.IMREAD_GRAYSCALE), (9, 6)) is None
