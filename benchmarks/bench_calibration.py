"""Camera calibration beside OpenCV's, on recordings where they are there, and its covariance by simulation."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.metric import ACCURACY, REPOSITORY, Metric, quickest, versus
from jaxloc.features.opencv.chessboard import board_points, find_chessboard
from jaxloc.poses import SE3
from jaxloc.refinement.calibration import (
    BrownConradyModel,
    Corners,
    Intrinsics,
    board_errors,
    calibrate,
    calibrate_stereo,
    camera_parameters,
)
from jaxloc.sensors import BrownConrady, Pinhole

_RECORDINGS = REPOSITORY.parent / "shared" / "data"
_GRID, _SQUARE, _SIGMA = (9, 6), 0.025, 0.2


def metrics(smoke: bool) -> Iterator[Metric]:
    with jax.enable_x64(True):
        yield from _simulated(4 if smoke else 100)
        if smoke or not _RECORDINGS.is_dir():
            return
        yield from _mono("carnd", "lanes_carnd_advanced/camera_cal/*.jpg", (720, 1280))
        yield from _mono("opencv", "stereo_calib_opencv/left[0-9]*.jpg", (480, 640))
        yield from _stereo((480, 640))


def _corners(pattern: str, shape: tuple[int, int]) -> np.ndarray:
    images = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in _sorted(pattern)]
    found = [find_chessboard(image, _GRID) for image in images if image.shape == shape]
    return np.stack([corners for corners in found if corners is not None])


def _sorted(pattern: str) -> list[Path]:
    return sorted(_RECORDINGS.glob(pattern))


def _for_opencv(corners: np.ndarray) -> tuple[list[np.ndarray], list[np.ndarray]]:
    plane = board_points(_GRID, _SQUARE).astype(np.float32)
    return [plane] * len(corners), [places.astype(np.float32)[:, None] for places in corners]


def _in_sigmas(fit: Any, which: int, matrix: np.ndarray, lens: np.ndarray) -> float:
    parameters = camera_parameters(fit, which)
    theirs = np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], 0.0, *lens.ravel()])
    sigma = np.asarray(parameters.sigmas())
    return float(np.max(np.abs(np.asarray(parameters.values) - theirs)[sigma > 0] / sigma[sigma > 0]))


def _mono(name: str, pattern: str, shape: tuple[int, int]) -> Iterator[Metric]:
    corners = _corners(pattern, shape)
    lists = _for_opencv(corners)

    def peer() -> Any:
        return cv2.calibrateCamera(*lists, shape[::-1], None, None)

    board, places = jnp.asarray(board_points(_GRID, _SQUARE)), jnp.asarray(corners)
    fit = calibrate(board, places, shape=shape).check()
    rms, matrix, lens, *_ = peer()
    ours = float(board_errors(fit.value.camera, fit.value.T_camera_board, board, places).rms)
    yield Metric(f"calibration.{name}.rms", ours, "px", "lower", ACCURACY)
    yield Metric(f"calibration.{name}.rms.vs_cv2", ours / rms, "of cv2's", "lower", 0.01)
    yield Metric(f"calibration.{name}.difference", _in_sigmas(fit, 0, matrix, lens), "sigma", "lower")
    time = quickest(lambda: calibrate(board, places, shape=shape).covariance, 5)
    yield Metric(f"calibration.{name}", 1e3 * time.wall, "ms", "lower")
    yield from versus(f"calibration.{name}.vs_cv2", time, quickest(lambda: peer() and None, 5))


def _stereo(shape: tuple[int, int]) -> Iterator[Metric]:
    sides = [_corners(f"stereo_calib_opencv/{name}[0-9]*.jpg", shape) for name in ("left", "right")]
    (plane, left), (_, right) = (_for_opencv(corners) for corners in sides)

    def peer() -> Any:
        alone = [cv2.calibrateCamera(plane, side, shape[::-1], None, None)[1:3] for side in (left, right)]
        stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-8)
        flags = cv2.CALIB_USE_INTRINSIC_GUESS
        return cv2.stereoCalibrate(plane, left, right, *alone[0], *alone[1], shape[::-1], criteria=stop, flags=flags)

    board, places = jnp.asarray(board_points(_GRID, _SQUARE)), [jnp.asarray(corners) for corners in sides]

    def ours() -> Any:
        return calibrate_stereo(board, *map(Corners, places), shape=shape)

    value = (fit := ours().check()).value
    other = jax.vmap(lambda pose: value.T_left_right.inverse() @ pose)(value.T_left_board)
    pairs = ((value.left, value.T_left_board), (value.right, other))
    errors = [float(board_errors(*pair, board, seen).rms) for pair, seen in zip(pairs, places, strict=True)]
    rms, k1, d1, k2, d2, *_ = peer()
    yield Metric("calibration.stereo.rms.vs_cv2", float(np.sqrt(np.mean(np.square(errors)))) / rms, "of cv2's", "lower")
    worst = max(_in_sigmas(fit, 0, k1, d1), _in_sigmas(fit, 1, k2, d2))
    yield Metric("calibration.stereo.difference", worst, "sigma", "lower")
    time = quickest(lambda: ours().covariance, 3)
    yield Metric("calibration.stereo", 1e3 * time.wall, "ms", "lower")
    yield from versus("calibration.stereo.vs_cv2", time, quickest(lambda: peer() and None, 3))


def _simulated(trials: int) -> Iterator[Metric]:
    """Calibrations of one scene under other noise: squared errors of 8 parameters in units of their covariance."""
    rng = np.random.default_rng(3)
    camera = Pinhole(520.0, 530.0, 325.0, 233.0, 0.0, BrownConrady((-0.25, 0.08, 1e-3, -5e-4, 0.0)))
    board = jnp.asarray(board_points((6, 5), 0.05))
    tilts, shifts = rng.uniform(-0.6, 0.6, (6, 3)), rng.uniform(-0.06, 0.06, (6, 2))

    def view(tilt: jax.Array, shift: jax.Array) -> jax.Array:
        turned = SE3.from_euler(jnp.zeros(3), yaw=tilt[0], pitch=tilt[1], roll=tilt[2])
        center = jnp.concatenate([shift, jnp.array([0.38])]) - turned.apply(jnp.mean(board, axis=0)[None])[0]
        return camera.project(SE3(turned.rotation, center).apply(board))

    corners = jax.vmap(view)(jnp.asarray(tilts), jnp.asarray(shifts))
    free = np.array([0, 1, 2, 3, 5, 6, 7, 8])
    truth = jnp.concatenate([jnp.atleast_1d(leaf) for leaf in jax.tree.leaves(camera)])[free]

    def trial(noise: jax.Array) -> tuple[jax.Array, jax.Array]:
        model = Intrinsics(BrownConradyModel(radial=2))
        fit = calibrate(board, corners + noise, intrinsics=model, shape=(480, 640), sigma=_SIGMA)
        found = camera_parameters(fit)
        error = found.values[free] - truth
        return error @ jnp.linalg.solve(found.covariance[np.ix_(free, free)], error), fit.ok

    noise = jnp.asarray(_SIGMA * rng.normal(size=(trials, *corners.shape)))
    # One by one: XLA's pool of CPU threads can lock up on large programs with LAPACK calls under vmap.
    each = jax.jit(trial)
    squared, ok = zip(*[each(one) for one in noise], strict=True)
    yield Metric("calibration.simulated.ok", float(np.mean(ok)), "share", "higher", 0.01)
    yield Metric("calibration.simulated.nees", float(np.mean(squared)), "of 8", "equal", ACCURACY)
