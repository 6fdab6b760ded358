"""Calibration of one camera from images of a planar board."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.linalg import block_diag
from jaxtyping import Array, Bool, Float

from jaxloc._arguments import checked
from jaxloc._jit import filter_jit
from jaxloc._linalg import matmul
from jaxloc.beliefs.validity import positive
from jaxloc.poses import SE3
from jaxloc.poses.lie_group import skew
from jaxloc.refinement.calibration.model import Intrinsics, Parametrization
from jaxloc.refinement.calibration.problem import BoardProblem, CameraProblem, Unknowns
from jaxloc.refinement.calibration.zhang import Views, center_board, closed_form, extent, finite_views
from jaxloc.sensors import Pinhole
from jaxloc.solvers import Estimate, LevenbergMarquardt, Quadratic, Solver, solve
from jaxloc.solvers.estimate import Status, guarded
from jaxloc.solvers.problem import is_quadratic

_MAX_STEPS = 100


class Calibrated(eqx.Module):
    """A calibrated camera and the poses of the boards.

    Attributes:
        camera: the camera.
        T_camera_board: a pose for each image.
    """

    camera: Pinhole
    T_camera_board: SE3


@filter_jit
@checked
def calibrate(
    board: Float[Array, "corners 3"],
    corners: Float[Array, "boards corners 2"],
    *,
    valid: Bool[Array, "boards corners"] | None = None,
    intrinsics: Intrinsics = Intrinsics(),
    shape: tuple[int, int] | None = None,
    sigma: Any = None,
    loss: Any = Quadratic(),
    solver: Solver = LevenbergMarquardt(),
) -> Estimate:
    """Focal lengths, principal point and lens of a camera from images of a planar board.

    Minimizes ``sum rho(|project(T_i X_j) - z_ij|^2 / sigma^2)`` over the camera and the poses ``T_i`` of the boards,
    starting at Zhang's closed form. All unknowns are estimated jointly, so that the covariance of the camera accounts
    for the uncertain poses.

    Focal length and distance, principal point and tilt, and the coefficients of a lens are strongly correlated: use
    float64 (``jax.enable_x64``). In float32 the values are accurate to about a fifth of their standard deviations for
    well-conditioned data; a nearly singular problem is reported as not ok earlier than in float64.

    Args:
        board: corners in the frame of the board, m, with z = 0.
        corners: their pixels in each image.
        valid: corners that are used; non-finite ones never are, nor images with fewer than six corners.
        intrinsics: parameters that are estimated.
        shape: (rows, columns) of the images, for the initial value, and for a fixed principal point.
        sigma: standard deviation of a coordinate of a corner, px; None estimates it from the residuals.
        loss: robust kernel over the two coordinates of a corner, in sigmas.
        solver: of the minimization.

    Returns:
        Estimate of a `Calibrated`, whose tangent is (fx, fy, cx, cy, skew, coefficients of the lens, poses). Fixed
        parameters have covariance zero, unused images the identity as pose. ``ok`` is False when boards are
        too few or all parallel, when a corner lies behind the camera, or when the solver did not converge. See
        `summarize` for names and standard deviations.

    Raises:
        ValueError: if the number of corners of board and images differ.

    References:
        Zhang, "A flexible new technique for camera calibration", T-PAMI 2000 [T-17], [T-16], [K-81].

    Example:
        >>> import jax, jax.numpy as jnp, jaxloc as jl
        >>> from jaxloc.refinement.calibration import Intrinsics, NoLens, calibrate
        >>> board = jnp.array([[0.1 * x, 0.1 * y, 0.0] for y in range(4) for x in range(5)])
        >>> def view(yaw, pitch, roll):
        ...     pose = jl.poses.SE3.from_euler(jnp.array([-0.2, -0.1, 1.0]), yaw, pitch, roll)
        ...     return jl.sensors.Pinhole(500.0, 510.0, 320.0, 240.0).project(pose.apply(board))
        >>> angles = jnp.array([[0.0, 0.3, 0.2], [0.2, -0.4, 0.1], [0.4, 0.1, -0.5], [0.1, -0.2, 0.4]])
        >>> fit = calibrate(board, jax.vmap(lambda a: view(*a))(angles), intrinsics=Intrinsics(NoLens()), sigma=0.1)
        >>> bool(fit.ok), round(float(fit.value.camera.fx)), round(float(fit.value.camera.fy))
        (True, 500, 510)
    """
    check_corners(board, corners)

    def run(board: Array, corners: Array, valid: Any, sigma: Any, loss: Any) -> Estimate:
        return _calibrate(finite_views(board, corners, valid), intrinsics, shape, sigma, loss, solver)

    return guarded(is_usable(sigma, board.dtype), run, board, corners, valid, sigma, loss)


def is_usable(sigma: Any, dtype: Any) -> Bool[Array, ""]:
    """Whether a standard deviation is positive and finite, or is to be estimated."""
    return jnp.array(True) if sigma is None else positive(jnp.asarray(sigma, dtype))


def _calibrate(
    views: Views, intrinsics: Intrinsics, shape: tuple[int, int] | None, sigma: Any, loss: Any, solver: Solver
) -> Estimate:
    center, (views,) = center_board(views)
    model, problem, initial = prepare(views, intrinsics, shape, loss)
    found = fit(problem, initial, sigma, solver)
    shifts = jnp.where(views.used()[:, None], center[None, :], 0.0)
    value = Calibrated(model.camera(found.value.shared), move_boards(found.value.boards, shifts))
    return transform_estimate(found, value, shifts, model.basis())


def prepare(
    views: Views, intrinsics: Intrinsics, shape: tuple[int, int] | None, loss: Any
) -> tuple[Parametrization, CameraProblem, Unknowns]:
    """The parametrization of a camera, its problem (of sigma 1 px), and the initial unknowns."""
    center, scale = jax.lax.stop_gradient(extent(views, shape))
    model = Parametrization.of(intrinsics, center, scale)
    first = closed_form(views, center, scale)
    initial = Unknowns(model.initial(first.focal, first.center), first.boards)
    problem = CameraProblem(model, views.board, views.pixels, views.valid, jnp.ones_like(scale), loss)
    return model, problem, initial


def check_corners(board: Array, *images: Array) -> None:
    """Checks that images show the corners of the board.

    Raises:
        ValueError: if the numbers of corners differ, or there are no images.
    """
    for corners in images:
        if not corners.size:
            raise ValueError(f"Calibration needs images with corners; their array has shape {corners.shape}.")
        if corners.shape[1] != board.shape[0]:
            raise ValueError(
                f"The board has {board.shape[0]} corners, the images {corners.shape[1]}: give every image all "
                "corners in the order of the board, and mask those that it does not show by `valid`."
            )


def fit(problem: BoardProblem, initial: Unknowns, sigma: Any, solver: Solver) -> Estimate:
    """Solves the problem; without a sigma it is estimated from the residuals, for covariance and robust kernels.

    Under plain least squares it does not affect the value. For robust kernels it is the median-based one after
    a plain fit, which is the initial value of the robust one.
    """
    views, dtype = Views(problem.board, problem.pixels, problem.valid), problem.sigma.dtype
    initial = jax.lax.stop_gradient(initial)
    if sigma is not None:
        problem = eqx.tree_at(lambda p: p.sigma, problem, jnp.asarray(sigma, dtype))
        return _checked(solve(problem, initial, solver=solver, max_steps=_MAX_STEPS))
    plain = eqx.tree_at(lambda p: (p.sigma, p.loss), problem, (jnp.ones((), dtype), Quadratic()))
    found = solve(plain, initial, solver=solver, max_steps=_MAX_STEPS)
    if is_quadratic(problem.loss):
        return _checked(_scaled(found, _variance(views, found)))
    robust = jax.lax.stop_gradient(_median_sigma(plain, found.value))
    problem = eqx.tree_at(lambda p: p.sigma, problem, robust)
    return _checked(solve(problem, found.value, solver=solver, max_steps=_MAX_STEPS))


def _num_dof(views: Views, found: Estimate) -> Float[Array, ""]:
    """Number of coordinates less the number of unknowns."""
    idle = SE3.dof * jnp.sum(~views.used())
    unknowns = found.covariance.shape[0] - idle
    return jnp.maximum(2 * jnp.sum(views.valid) - unknowns, 1).astype(found.cost.dtype)


def _variance(views: Views, found: Estimate) -> Float[Array, ""]:
    """Variance of a coordinate, px^2, from the residuals in px; bounded below by rounding."""
    eps = float(jnp.finfo(found.cost.dtype).eps)
    return jnp.maximum(2.0 * found.cost / _num_dof(views, found), (4.0 * eps * 1e3) ** 2)


def _scaled(found: Estimate, variance: Float[Array, ""]) -> Estimate:
    """The estimate for residuals whitened with this variance."""
    return Estimate(
        found.value,
        found.covariance * variance,
        found.cost / variance,
        found.ok,
        found.num_steps,
        found.status,
        found.information / variance,
    )


def _median_sigma(problem: BoardProblem, state: Unknowns) -> Float[Array, ""]:
    """Standard deviation of a coordinate, px, by the median of the errors, robust to outliers."""
    errors, _ = problem.residual(state)
    squared = jnp.sum(errors**2, axis=0)
    valid = problem.valid.reshape(-1)
    ranked = jnp.sort(jnp.where(valid, squared, jnp.inf))
    middle = ranked[jnp.maximum(jnp.sum(valid) // 2, 0).clip(0, valid.size - 1)]
    # The median of chi-square with two degrees of freedom is 2 ln 2.
    sigma = jnp.sqrt(jnp.where(jnp.isfinite(middle), middle, 1.0) / (2.0 * jnp.log(2.0)))
    return jnp.maximum(sigma.astype(errors.dtype), 1e-3)


def _checked(found: Estimate) -> Estimate:
    """Not ok where an unknown, in units of the image, is undetermined."""
    size = found.covariance.shape[0] - SE3.dof * found.value.boards.translation.shape[0]
    shared = jnp.diagonal(found.covariance)[:size]
    open_ = ~jnp.all(shared[:2] < 1.0)
    status = jnp.where(found.ok & open_, int(Status.RANK_DEFICIENT), found.status)
    return eqx.tree_at(lambda e: (e.ok, e.status), found, (found.ok & ~open_, status))


def move_boards(boards: SE3, shifts: Float[Array, "n 3"]) -> SE3:
    """Poses of boards from those of frames of the same axes at `shifts` on them."""

    def one(pose: SE3, shift: Array) -> SE3:
        return SE3(pose.rotation, pose.translation - pose.rotation.apply(shift[None])[0])

    return jax.vmap(one)(boards, shifts)


def transform_estimate(found: Estimate, value: Any, shifts: Float[Array, "n 3"], *bases: Array) -> Estimate:
    """Linear transform of an estimate: of the first parameters by bases, of the boards by their shifts.

    Args:
        found: of the unknowns.
        value: of the parameters.
        shifts: of the boards, see `move_boards`.
        bases: derivatives of the first parameters by the first unknowns, block by block.
    """
    eye, zero = jnp.eye(3, dtype=shifts.dtype), jnp.zeros((3, 3), shifts.dtype)
    turned = jax.vmap(lambda shift: jnp.block([[eye, skew(shift)], [zero, eye]]))(shifts)
    # The transpose of the inverse, which transforms information.
    dual = jax.vmap(lambda shift: jnp.block([[eye, zero], [skew(shift), eye]]))(shifts)
    forward = block_diag(*bases, _block_diagonal(turned))
    back = block_diag(*(basis / jnp.sum(basis**2, axis=0)[None, :] for basis in bases), _block_diagonal(dual))
    covariance = matmul(forward, matmul(found.covariance, forward.T))
    information = matmul(back, matmul(found.information, back.T))
    return Estimate(value, covariance, found.cost, found.ok, found.num_steps, found.status, information)


def _block_diagonal(blocks: Float[Array, "n k k"]) -> Float[Array, "d d"]:
    count, size, _ = blocks.shape
    every = jnp.arange(count)
    table = jnp.zeros((count, size, count, size), blocks.dtype).at[every, :, every, :].set(blocks)
    return table.reshape(count * size, count * size)
