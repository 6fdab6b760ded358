"""One camera from boards: OpenCV's parameters and standard deviations, NEES, gradients, what cannot be determined."""

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2

from jaxloc.features.opencv.chessboard import board_points, find_chessboard
from jaxloc.poses import SE3, retract
from jaxloc.refinement.calibration import (
    BrownConradyModel,
    Calibrated,
    Fisheye,
    Intrinsics,
    NoLens,
    board_errors,
    calibrate,
    camera_parameters,
)
from jaxloc.refinement.calibration.camera import check_corners, prepare
from jaxloc.refinement.calibration.zhang import finite_views
from jaxloc.sensors import BrownConrady, KannalaBrandt, Pinhole
from jaxloc.solvers import Huber, Problem, Quadratic

pytestmark = pytest.mark.heavy

SHAPE, NUM = (480, 640), 6
BOARD = board_points((6, 5), 0.05)
TWO = Intrinsics(BrownConradyModel(radial=2))
TILTS = np.random.default_rng(4).uniform(-0.6, 0.6, (NUM, 3))


def truth(lens=BrownConrady, coefficients=(-0.25, 0.08, 1e-3, -5e-4, 0.0)):
    return Pinhole(520.0, 530.0, 325.0, 233.0, 0.0, None if lens is None else lens(coefficients))


def poses(tilts=TILTS):
    """Boards about 0.35 m away whose centers are spread over the image."""
    rng = np.random.default_rng(1)
    centers = np.column_stack([rng.uniform(-0.06, 0.06, (len(tilts), 2)), rng.uniform(0.33, 0.42, len(tilts))])

    def place(center, tilt):
        turned = SE3.from_euler(jnp.zeros(3), yaw=tilt[0], pitch=tilt[1], roll=tilt[2])
        shift = -turned.apply(jnp.asarray(BOARD.mean(axis=0))[None])[0]
        return SE3(turned.rotation, center + shift)

    return jax.vmap(place)(jnp.asarray(centers), jnp.asarray(tilts))


def photos(camera=None, tilts=TILTS):
    camera = truth() if camera is None else camera
    return jax.vmap(lambda pose: camera.project(pose.apply(jnp.asarray(BOARD))))(poses(tilts))


def noisy(rng, sigma=0.2):
    return photos() + sigma * jnp.asarray(rng.normal(size=(NUM, len(BOARD), 2)))


def numbers(camera):
    return np.concatenate([np.atleast_1d(leaf) for leaf in jax.tree.leaves(camera)])


def finite(tree):
    return all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(tree) if eqx.is_inexact_array(leaf))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("intrinsics", "camera"),
    [
        (TWO, truth()),
        (Intrinsics(Fisheye(2)), truth(KannalaBrandt, (0.03, -0.01, 0.0, 0.0))),
        (
            Intrinsics(NoLens(), square_pixels=True, principal_point=False),
            Pinhole(500.0, 500.0, 319.5, 239.5),
        ),
    ],
    ids=["glass", "fisheye", "fixed"],
)
def test_exact_corners_give_the_exact_camera(x64, intrinsics, camera):
    camera = jax.tree.map(lambda leaf: leaf.astype(jnp.float64), camera)
    fit = calibrate(jnp.asarray(BOARD), photos(camera), intrinsics=intrinsics, shape=SHAPE, sigma=0.1)
    assert bool(fit.ok), fit.describe()
    np.testing.assert_allclose(numbers(fit.value.camera), numbers(camera), rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(fit.value.T_camera_board.translation, poses().translation, atol=1e-6)
    parameters = camera_parameters(fit)
    held = [name for name, sigma in zip(parameters.names, parameters.sigmas(), strict=True) if sigma == 0]
    moving = {"fx", "fy"} if "f" in intrinsics.free() else set()
    assert set(held) == set(intrinsics.names()) - set(intrinsics.free()) - moving


@pytest.mark.slow
def test_parameters_and_sigmas_are_those_of_opencv(x64, rng):
    corners = noisy(rng)
    fit = calibrate(jnp.asarray(BOARD), corners, intrinsics=TWO, shape=SHAPE)
    places = [np.asarray(photo, np.float32)[:, None] for photo in corners]
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 200, 1e-13)
    options = {"flags": cv2.CALIB_FIX_K3, "criteria": stop}
    plane = [BOARD.astype(np.float32)] * NUM
    rms, matrix, lens, _, _, sigmas, _, each = cv2.calibrateCameraExtended(
        plane, places, SHAPE[::-1], None, None, **options
    )
    ours = camera_parameters(fit)
    theirs = np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], 0.0, *lens.ravel()])
    sigma = np.asarray(ours.sigmas())
    assert ours.names == ("fx", "fy", "cx", "cy", "skew", "k1", "k2", "p1", "p2", "k3")
    assert (np.abs(np.asarray(ours.values) - theirs) <= 0.01 * sigma).all()
    expected = np.insert(sigmas.ravel()[:9], 4, 0.0)
    # OpenCV and we count the same degrees of freedom.
    np.testing.assert_allclose(sigma[expected > 0], expected[expected > 0], rtol=0.02)
    left = board_errors(fit.value.camera, fit.value.T_camera_board, jnp.asarray(BOARD), corners)
    assert float(left.rms) <= rms * 1.0001
    np.testing.assert_allclose(left.board_rms, each.ravel(), rtol=1e-3)
    assert 2 * float(fit.cost) == pytest.approx(2 * NUM * len(BOARD) - 8 - 6 * NUM, rel=1e-6)


@pytest.mark.slow
def test_covariance_is_confirmed_by_simulated_calibrations(x64, rng):
    """NEES of the camera over 100 calibrations of other noise, sigma known: inside the chi-square band."""
    trials, sigma = 100, 0.2
    free = np.array([0, 1, 2, 3, 5, 6, 7, 8])
    expected, nees = numbers(truth())[free], []
    for _ in range(trials):
        fit = calibrate(jnp.asarray(BOARD), noisy(rng, sigma), intrinsics=TWO, shape=SHAPE, sigma=sigma)
        assert bool(fit.ok)
        parameters = camera_parameters(fit)
        difference = np.asarray(parameters.values)[free] - expected
        nees.append(difference @ np.linalg.solve(np.asarray(parameters.covariance)[np.ix_(free, free)], difference))
    low, high = chi2.ppf([0.005, 0.995], 8 * trials) / trials
    assert low < np.mean(nees) < high


@pytest.mark.slow
def test_gradients_are_those_of_finite_differences(x64, rng):
    corners = noisy(rng, 0.5)

    @jax.jit
    def sum_of(corners):
        camera = calibrate(jnp.asarray(BOARD), corners, intrinsics=TWO, shape=SHAPE).value.camera
        return camera.fx + 0.3 * camera.cy + 100.0 * camera.lens.coefficients[0]

    gradient = jax.jit(jax.grad(sum_of))(corners)
    for place in ((0, 3, 0), (4, 17, 1)):
        step = jnp.zeros_like(corners).at[place].set(1e-3)
        numeric = (sum_of(corners + step) - sum_of(corners - step)) / 2e-3
        assert float(gradient[place]) == pytest.approx(float(numeric), rel=1e-4, abs=1e-6)


@pytest.mark.slow
def test_masked_is_absent(x64, rng):
    corners = noisy(rng)
    valid = np.ones((NUM, len(BOARD)), bool)
    valid[2] = False
    valid[4, 3:9] = False
    dirty = jnp.where(jnp.asarray(valid)[..., None], corners, jnp.nan)
    masked = calibrate(jnp.asarray(BOARD), dirty, intrinsics=TWO, shape=SHAPE)
    explicit = calibrate(jnp.asarray(BOARD), corners, valid=jnp.asarray(valid), intrinsics=TWO, shape=SHAPE)
    keep = np.arange(NUM) != 2
    absent = calibrate(jnp.asarray(BOARD), dirty[keep], intrinsics=TWO, shape=SHAPE)
    assert bool(masked.ok) and bool(absent.ok) and finite(masked)
    np.testing.assert_allclose(numbers(masked.value.camera), numbers(explicit.value.camera), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(numbers(masked.value.camera), numbers(absent.value.camera), rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(masked.covariance[:10, :10], absent.covariance[:10, :10], rtol=1e-4, atol=1e-12)
    np.testing.assert_array_equal(masked.value.T_camera_board.translation[2], 0.0)


@pytest.mark.slow
def test_outliers_are_outvoted(x64, rng):
    corners = noisy(rng, 0.1)
    wrong = corners.at[0, 5].add(8.0).at[3, 20].add(-6.0)
    clean = calibrate(jnp.asarray(BOARD), corners, intrinsics=TWO, shape=SHAPE)
    plain = calibrate(jnp.asarray(BOARD), wrong, intrinsics=TWO, shape=SHAPE)
    robust = calibrate(jnp.asarray(BOARD), wrong, intrinsics=TWO, shape=SHAPE, loss=Huber(2.0))
    assert bool(robust.ok)
    right, sigmas = numbers(clean.value.camera), np.asarray(camera_parameters(clean).sigmas())
    plain_gap, robust_gap = (
        np.max(np.abs(numbers(fit.value.camera) - right)[sigmas > 0] / sigmas[sigmas > 0]) for fit in (plain, robust)
    )
    assert robust_gap < 0.2 * plain_gap


@pytest.mark.slow
def test_what_cannot_be_determined(x64, rng):
    corners = noisy(rng)
    flat = photos(tilts=np.tile([[0.1, 0.2, -0.1]], (NUM, 1)))
    for bad in (
        flat,
        flat + 0.1 * jnp.asarray(rng.normal(size=flat.shape)),
        jnp.where(jnp.arange(NUM)[:, None, None] == 0, corners, jnp.nan),
        jnp.full_like(corners, jnp.nan),
        jnp.zeros_like(corners),
        jnp.asarray(rng.normal(size=corners.shape)) * 1e8,
        jnp.full_like(corners, 1e300),
    ):
        fit = calibrate(jnp.asarray(BOARD), bad, intrinsics=TWO, shape=SHAPE)
        assert not bool(fit.ok), fit.describe()
        assert finite(fit)
    with pytest.raises(ValueError, match="29 corners"):
        check_corners(jnp.asarray(BOARD[:29]), corners)
    with pytest.raises(ValueError, match="radial=5"):
        BrownConradyModel(5)
    with pytest.raises(ValueError, match="radial=9"):
        Fisheye(9)


@pytest.mark.slow
def test_gradients_of_bad_corners_are_finite(x64):
    bad = jnp.zeros((NUM, len(BOARD), 2)).at[0].set(jnp.nan)
    gradient = jax.grad(lambda c: calibrate(jnp.asarray(BOARD), c, intrinsics=TWO, shape=SHAPE).value.camera.fx)(bad)
    np.testing.assert_array_equal(gradient, 0.0)


@pytest.mark.slow
def test_single_precision_is_near(rng):
    corners, board = np.asarray(noisy(rng), np.float32), BOARD.astype(np.float32)
    fit = calibrate(jnp.asarray(board), jnp.asarray(corners), intrinsics=TWO, shape=SHAPE)
    assert fit.value.camera.fx.dtype == jnp.float32 and fit.covariance.dtype == jnp.float32 and bool(fit.ok)
    with jax.enable_x64(True):
        exact = camera_parameters(
            calibrate(jnp.asarray(BOARD), jnp.asarray(corners, jnp.float64), intrinsics=TWO, shape=SHAPE)
        )
        values, sigmas = np.asarray(exact.values), np.asarray(exact.sigmas())
    difference = np.abs(numbers(fit.value.camera) - values)
    assert (difference <= 0.2 * sigmas).all()


@pytest.mark.slow
def test_derivatives_picture_by_picture_are_those_of_the_whole(x64, rng):
    corners = noisy(rng)[:3].at[1].set(jnp.nan)
    views = finite_views(jnp.asarray(BOARD), corners, None)
    _, problem, start = eqx.filter_jit(prepare)(views, TWO, SHAPE, Huber(1.0))
    state = retract(start, 0.01 * jnp.asarray(rng.normal(size=8 + 18)))
    ours = eqx.filter_jit(lambda p, x: p.linearize(x))(problem, state)
    whole = eqx.filter_jit(Problem.linearize)(problem, state)
    for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(whole), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-6)
    # Idle poses rest at the identity, where their second derivatives vanish only at a minimum.
    calm = eqx.tree_at(lambda s: s.boards, state, start.boards)
    calm = eqx.tree_at(lambda p: p.loss, problem, Quadratic()), calm
    ours = eqx.filter_jit(lambda p, x: p.hessian(x))(*calm)
    np.testing.assert_allclose(ours, eqx.filter_jit(Problem.hessian)(*calm), rtol=1e-6, atol=1e-3)


@pytest.mark.slow
@pytest.mark.recordings
@pytest.mark.parametrize(
    ("pattern", "grid"),
    [("lanes_carnd_advanced/camera_cal/*.jpg", 720), ("stereo_calib_opencv/left*.jpg", 480)],
    ids=["carnd", "opencv"],
)
def test_recordings_against_opencv(recordings, x64, pattern, grid):
    """The bars: reprojection error at most 1 % above OpenCV's, parameters within 3 standard deviations."""
    images = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in sorted(recordings.glob(pattern))]
    found = [find_chessboard(image, (9, 6)) for image in images if image.shape[0] == grid]
    places = [corners for corners in found if corners is not None]
    shape, board = (grid, images[0].shape[1]), board_points((9, 6), 0.025)
    rms, matrix, lens, *_ = cv2.calibrateCamera(
        [board.astype(np.float32)] * len(places),
        [corners.astype(np.float32)[:, None] for corners in places],
        shape[::-1],
        None,
        None,
    )
    corners = jnp.asarray(np.stack(places))
    fit = calibrate(jnp.asarray(board), corners, shape=shape)
    assert bool(fit.ok) and len(places) >= 13 and isinstance(fit.value, Calibrated)
    left = board_errors(fit.value.camera, fit.value.T_camera_board, jnp.asarray(board), corners)
    assert float(left.rms) <= 1.01 * rms
    theirs = np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], 0.0, *lens.ravel()])
    parameters = camera_parameters(fit)
    assert (np.abs(np.asarray(parameters.values) - theirs) <= 3.0 * np.asarray(parameters.sigmas())).all()


@pytest.mark.slow
@pytest.mark.parametrize("far", [0.9, 100.0])
def test_the_origin_of_the_board_does_not_matter(x64, rng, far):
    """Corners far from the origin: the same camera, the same boards, the same uncertainty of each corner."""
    corners, shift = noisy(rng), np.array([far, -0.5 * far, 0.0])
    near, moved = (calibrate(jnp.asarray(BOARD + s), corners, intrinsics=TWO, sigma=0.2) for s in (0.0 * shift, shift))
    assert bool(near.ok) and bool(moved.ok)
    np.testing.assert_allclose(numbers(moved.value.camera), numbers(near.value.camera), rtol=1e-6)
    places = [
        jax.vmap(lambda pose, board=BOARD + s: pose.apply(jnp.asarray(board)))(fit.value.T_camera_board)
        for fit, s in ((near, 0.0), (moved, shift))
    ]
    np.testing.assert_allclose(*places, atol=1e-7)
    size = near.covariance.shape[0] - 6 * NUM
    np.testing.assert_allclose(moved.covariance[:size, :size], near.covariance[:size, :size], rtol=1e-4, atol=1e-12)
    # A corner moves with the translation of its frame, and with the rotation by its lever.
    arm = np.eye(3, 6)
    arm[:, 3:] = -np.array([[0, -shift[2], shift[1]], [shift[2], 0, -shift[0]], [-shift[1], shift[0], 0]])
    corner = arm @ np.asarray(moved.covariance[size : size + 6, size : size + 6]) @ arm.T
    np.testing.assert_allclose(corner, near.covariance[size : size + 3, size : size + 3], rtol=1e-3, atol=1e-12)
