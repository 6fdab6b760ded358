"""Calibration of a camera, or of a stereo rig with its rectification, from corners of a chessboard; in float64."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float64

from jaxloc.multiview.rectification import Rectification, rectify
from jaxloc.pipelines.board_order import find_orders
from jaxloc.refinement.calibration import (
    BrownConradyModel,
    Corners,
    Fisheye,
    Intrinsics,
    Parameters,
    board_errors,
    calibrate,
    calibrate_stereo,
    camera_parameters,
)
from jaxloc.sensors import Pinhole
from jaxloc.solvers import Estimate, Huber, Quadratic


class Config(eqx.Module):
    """Options: which parameters are estimated.

    Attributes:
        radial: number of radial coefficients: 0 to 3, or 6 for the rational model; 0 to 4 of a fisheye lens.
        tangential: whether tangential coefficients are estimated.
        fisheye: whether the lens is a fisheye.
        square_pixels: whether rows and columns share one focal length.
        principal_point: whether it is estimated; otherwise it is the center of the images.
        robust: threshold of Huber's loss, in standard deviations; 0 for plain least squares.
    """

    radial: int = 3
    tangential: bool = True
    fisheye: bool = False
    square_pixels: bool = False
    principal_point: bool = True
    robust: float = 0.0

    def __check_init__(self) -> None:
        self.intrinsics()
        if self.robust < 0.0:
            raise ValueError(f"robust is {self.robust:g}, must not be negative")

    def intrinsics(self) -> Intrinsics:
        """The parameters that are estimated."""
        lens = Fisheye(self.radial) if self.fisheye else BrownConradyModel(self.radial, self.tangential)
        return Intrinsics(lens, self.square_pixels, self.principal_point)


class Views(eqx.Module):
    """Corners of a board in the images of one camera.

    Attributes:
        board: corners in the frame of the board, m.
        corners: px; zero where the board was not found.
        found: images in which it was found.
        shape: (rows, columns).
    """

    board: Float64[np.ndarray, "m 3"]
    corners: Float64[np.ndarray, "n m 2"]
    found: Bool[np.ndarray, " n"]
    shape: tuple[int, int]


class Side(eqx.Module):
    """Calibration of one camera.

    Attributes:
        camera: the camera.
        parameters: its parameters, with covariance.
        errors: predicted minus measured corners, px; zero where the board was not found.
        board_rms: of each image, px; zero where the board was not found.
        rms: of all, px.
    """

    camera: Pinhole
    parameters: Parameters
    errors: Float64[np.ndarray, "n m 2"]
    board_rms: Float64[np.ndarray, " n"]
    rms: float


class Result(eqx.Module):
    """A calibration.

    Attributes:
        sides: the camera, or the left and the right one.
        estimate: of all unknowns.
        rectification: of a pair.
        status: result of the solver, as text.
        turned: pairs whose right corners were put into another order, which the errors do not follow: they are in the
            order that was given. See `board_order`.
    """

    sides: tuple[Side, ...]
    estimate: Estimate
    rectification: Rectification | None
    status: str
    turned: Bool[np.ndarray, " n"] | None = None

    @property
    def ok(self) -> bool:
        """Whether the solver converged to a usable estimate."""
        return bool(self.estimate.ok)


def run(views: tuple[Views, ...], config: Config = Config()) -> Result:
    """Calibrates one camera, or a stereo rig, in float64 whatever JAX's default is.

    Args:
        views: of the camera; or of the left and of the right camera, image by image at the same instants.
        config: options.

    Returns:
        The calibration.

    Raises:
        ValueError: if there are not one or two cameras, or two with different numbers of images.
    """
    if len(views) not in (1, 2) or len({len(side.corners) for side in views}) != 1:
        raise ValueError("Give the views of one camera, or of two with as many images each.")
    with jax.enable_x64(True):
        return _mono(views[0], config) if len(views) == 1 else _stereo(views[0], views[1], config)


def _loss(config: Config) -> Any:
    return Huber(config.robust) if config.robust > 0.0 else Quadratic()


def _mono(views: Views, config: Config) -> Result:
    board, corners = jnp.asarray(views.board), _corners(views)
    fit = calibrate(
        board,
        corners.pixels,
        valid=corners.valid,
        intrinsics=config.intrinsics(),
        shape=views.shape,
        loss=_loss(config),
    )
    side = _side(fit.value.camera, fit.value.T_camera_board, views, camera_parameters(fit))
    return Result((side,), fit, None, fit.describe())


def _stereo(left: Views, right: Views, config: Config) -> Result:
    orders = find_orders(left.board, left.corners, right.corners, left.found & right.found, left.shape)
    given, turned = right, (orders != np.arange(len(left.board))).any(axis=1)
    right = eqx.tree_at(lambda v: v.corners, given, np.take_along_axis(given.corners, orders[..., None], axis=1))
    sides = _corners(left), _corners(right)
    board = jnp.asarray(left.board)
    fit = calibrate_stereo(board, *sides, intrinsics=config.intrinsics(), shape=left.shape, loss=_loss(config))
    value = fit.value
    boards_right = jax.vmap(lambda pose: value.T_left_right.inverse() @ pose)(value.T_left_board)
    second = _side(value.right, boards_right, right, camera_parameters(fit, 1))
    errors = np.take_along_axis(second.errors, np.argsort(orders, axis=1)[..., None], axis=1)
    second = eqx.tree_at(lambda s: s.errors, second, errors)
    pair = (_side(value.left, value.T_left_board, left, camera_parameters(fit, 0)), second)
    rectified = rectify(value.left, value.right, value.T_left_right, shape=left.shape)
    return Result(pair, fit, rectified, fit.describe(), turned)


def _corners(views: Views) -> Corners:
    valid = np.broadcast_to(views.found[:, None], views.corners.shape[:2])
    return Corners(jnp.asarray(views.corners), jnp.asarray(valid))


def _side(camera: Pinhole, boards: Any, views: Views, parameters: Parameters) -> Side:
    corners = _corners(views)
    residuals = board_errors(camera, boards, jnp.asarray(views.board), corners.pixels, valid=corners.valid)
    return Side(camera, parameters, np.asarray(residuals.errors), np.asarray(residuals.board_rms), float(residuals.rms))
