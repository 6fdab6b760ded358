"""Boards that look the same when turned: pairs seen from different ends."""

import cv2
import numpy as np
import pytest

from jaxloc.features.opencv.chessboard import board_points
from jaxloc.pipelines.board_order import find_orders

MATRIX = np.array([[520.0, 0.0, 320.0], [0.0, 520.0, 240.0], [0.0, 0.0, 1.0]])


def corners(board, number, roll, rng):
    """Left and right corners of some boards; the right camera is rolled against the left one."""
    rig = cv2.Rodrigues(np.array([0.004, -0.01, roll]))[0]
    found = [[], []]
    for _ in range(number):
        turn = cv2.Rodrigues(rng.uniform(-0.5, 0.5, 3))[0]
        points = (board - board.mean(axis=0)) @ turn.T + [*rng.uniform(-0.05, 0.05, 2), 0.7]
        for side, moved in enumerate((points, points @ rig.T + [-0.12, 0.001, 0.002])):
            pixels = moved @ MATRIX.T
            found[side].append(pixels[:, :2] / pixels[:, 2:] + rng.normal(0.0, 0.1, (len(board), 2)))
    return np.array(found[0]), np.array(found[1])


@pytest.mark.parametrize("grid", [(8, 6), (7, 5), (7, 7)])
@pytest.mark.parametrize("roll", [0.02, 1.6, np.pi])
@pytest.mark.parametrize("share", [0.0, 0.34, 1.0])
def test_turned_boards_are_turned_back(rng, grid, roll, share):
    board = board_points(grid, 0.03)
    left, right = corners(board, 12, roll, rng)
    indices, given = np.arange(len(board)).reshape(grid[1], grid[0]), right.copy()
    for view in range(round(12 * share)):
        quarter = view % 3 + 1 if grid[0] == grid[1] else 2
        given[view] = right[view][np.rot90(indices, quarter).ravel()]
    orders = find_orders(board, left, given, np.ones(12, bool), (480, 640))
    np.testing.assert_array_equal(np.take_along_axis(given, orders[..., None], axis=1), right)


def test_boards_that_show_how_they_lie_are_left_alone(rng):
    board = board_points((9, 6), 0.03)
    left, right = corners(board, 4, 0.02, rng)
    orders = find_orders(board, left, right[:, ::-1], np.ones(4, bool), (480, 640))
    np.testing.assert_array_equal(orders, np.tile(np.arange(54), (4, 1)))


def test_pairs_of_which_one_camera_sees_nothing_are_left_alone(rng):
    board = board_points((8, 6), 0.03)
    left, right = corners(board, 6, 0.02, rng)
    left[0], right[1] = 0.0, right[1, ::-1]
    orders = find_orders(board, left, right, np.arange(6) > 0, (480, 640))
    assert (orders[0] == np.arange(48)).all() and (orders[1] == np.arange(48)[::-1]).all()
    assert (find_orders(board, left, right, np.zeros(6, bool), (480, 640)) == np.arange(48)).all()
