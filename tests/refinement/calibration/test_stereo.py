"""Two cameras from boards: exact corners, boards seen by one, OpenCV's answer, what cannot be determined."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.features.opencv.chessboard import board_points, find_chessboard
from jaxloc.poses import SE3
from jaxloc.refinement.calibration import (
    BrownConradyModel,
    Corners,
    Intrinsics,
    board_errors,
    calibrate_stereo,
    camera_parameters,
)
from jaxloc.sensors import BrownConrady, Pinhole

pytestmark = pytest.mark.heavy

SHAPE, NUM = (480, 640), 6
BOARD = board_points((6, 5), 0.05)
TWO = Intrinsics(BrownConradyModel(radial=2))


def scene(rng):
    """Corners in both cameras, the cameras and the rig."""
    left = Pinhole(520.0, 530.0, 325.0, 233.0, 0.0, BrownConrady((-0.25, 0.08, 1e-3, -5e-4, 0.0)))
    right = Pinhole(510.0, 515.0, 315.0, 243.0, 0.0, BrownConrady((-0.2, 0.05, 0.0, 5e-4, 0.0)))
    rig = SE3.from_euler(jnp.array([0.1, 0.005, -0.003]), yaw=0.01, pitch=-0.05, roll=0.02)
    tilts = jnp.asarray(rng.uniform(-0.6, 0.6, (NUM, 3)))
    centers = jnp.asarray(np.column_stack([rng.uniform(-0.05, 0.08, (NUM, 2)), rng.uniform(0.4, 0.5, NUM)]))

    def view(center, tilt):
        turned = SE3.from_euler(jnp.zeros(3), yaw=tilt[0], pitch=tilt[1], roll=tilt[2])
        pose = SE3(turned.rotation, center - turned.apply(jnp.asarray(BOARD.mean(axis=0))[None])[0])
        other = rig.inverse() @ pose
        return left.project(pose.apply(jnp.asarray(BOARD))), right.project(other.apply(jnp.asarray(BOARD)))

    return *jax.vmap(view)(centers, tilts), left, right, rig


def numbers(tree):
    return np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(tree)])


@pytest.mark.slow
def test_exact_corners_and_boards_that_one_camera_sees(x64, rng):
    first, second, left, right, rig = scene(rng)
    first, second = first.at[1].set(jnp.nan), second.at[2].set(jnp.nan)
    fit = calibrate_stereo(jnp.asarray(BOARD), Corners(first), Corners(second), intrinsics=TWO, shape=SHAPE, sigma=0.1)
    assert bool(fit.ok), fit.describe()
    np.testing.assert_allclose(numbers(fit.value.left), numbers(left), rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(numbers(fit.value.right), numbers(right), rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(fit.value.T_left_right.matrix(), rig.matrix(), atol=1e-7)
    assert camera_parameters(fit, 1).values[0] == fit.value.right.fx
    assert fit.covariance.shape == (26 + 6 * NUM,) * 2 and bool(jnp.all(jnp.diagonal(fit.covariance) >= 0))


@pytest.mark.slow
def test_what_cannot_be_determined(x64, rng):
    first, second, *_ = scene(rng)
    odd = jnp.arange(NUM)[:, None, None] % 2 == 0
    apart = jnp.where(odd, first, jnp.nan), jnp.where(odd, jnp.nan, second)
    for bad in (apart, (jnp.full_like(first, jnp.nan), second), (jnp.zeros_like(first), second)):
        fit = calibrate_stereo(jnp.asarray(BOARD), *map(Corners, bad), intrinsics=TWO, shape=SHAPE)
        assert not bool(fit.ok), fit.describe()
        assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(fit))


@pytest.mark.slow
@pytest.mark.recordings
def test_recordings_against_opencv(recordings, x64):
    """The bars: reprojection error at most 1 % above OpenCV's, parameters within 3 standard deviations."""
    places = [[], []]
    for side, name in zip(places, ("left", "right"), strict=True):
        for path in sorted((recordings / "stereo_calib_opencv").glob(f"{name}[0-9]*.jpg")):
            side.append(find_chessboard(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), (9, 6)))
    assert all(corners is not None for side in places for corners in side)
    board = board_points((9, 6), 0.025)
    plane = [board.astype(np.float32)] * len(places[0])
    lists = [[corners.astype(np.float32)[:, None] for corners in side] for side in places]
    alone = [cv2.calibrateCamera(plane, side, SHAPE[::-1], None, None)[1:3] for side in lists]
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-8)
    rms, k1, d1, k2, d2, rotation, translation, *_ = cv2.stereoCalibrate(
        plane, *lists, *alone[0], *alone[1], SHAPE[::-1], criteria=stop, flags=cv2.CALIB_USE_INTRINSIC_GUESS
    )
    corners = [jnp.asarray(np.stack(side)) for side in places]
    fit = calibrate_stereo(jnp.asarray(board), *map(Corners, corners), shape=SHAPE)
    assert bool(fit.ok)
    value = fit.value
    other = jax.vmap(lambda pose: value.T_left_right.inverse() @ pose)(value.T_left_board)
    sides = ((value.left, value.T_left_board), (value.right, other))
    left_over = [board_errors(*side, jnp.asarray(board), seen).rms for side, seen in zip(sides, corners, strict=True)]
    assert float(np.sqrt(np.mean(np.square(left_over)))) <= 1.01 * rms
    for which, (matrix, lens) in enumerate(((k1, d1), (k2, d2))):
        parameters = camera_parameters(fit, which)
        theirs = np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], 0.0, *lens.ravel()])
        assert (np.abs(np.asarray(parameters.values) - theirs) <= 3.0 * np.asarray(parameters.sigmas())).all()
    pose = jnp.asarray(np.vstack([np.hstack([rotation, translation]), [0, 0, 0, 1]]))
    difference = np.asarray(value.T_left_right.local(SE3.from_matrix(pose).inverse()))
    sigma = np.sqrt(np.diag(fit.covariance))[20:26]
    assert (np.abs(difference) <= 3.0 * sigma).all()
