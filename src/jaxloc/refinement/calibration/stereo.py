"""Calibration of a stereo pair from images of a planar board."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxloc import _linalg
from jaxloc._arguments import checked
from jaxloc._jit import filter_jit
from jaxloc._linalg import matmul
from jaxloc.poses import SE3, SO3
from jaxloc.refinement.calibration.camera import check_corners, fit, is_usable, move_boards, prepare, transform_estimate
from jaxloc.refinement.calibration.model import Intrinsics
from jaxloc.refinement.calibration.problem import CameraProblem, Rig, StereoProblem, Unknowns
from jaxloc.refinement.calibration.zhang import center_board, finite_views
from jaxloc.sensors import Pinhole
from jaxloc.solvers import Estimate, LevenbergMarquardt, Quadratic, solve
from jaxloc.solvers.estimate import guarded


class Corners(eqx.Module):
    """Corners of a board in the images of one camera.

    Attributes:
        pixels: px.
        valid: corners that are used; None for all. Non-finite ones never are.
    """

    pixels: Float[Array, "boards corners 2"]
    valid: Bool[Array, "boards corners"] | None = None


class CalibratedStereo(eqx.Module):
    """Two calibrated cameras and the poses of the boards.

    Attributes:
        left: the left camera.
        right: the right camera.
        T_left_right: pose of the right camera in the left one's frame.
        T_left_board: a pose for each pair of images.
    """

    left: Pinhole
    right: Pinhole
    T_left_right: SE3
    T_left_board: SE3


@filter_jit
@checked
def calibrate_stereo(
    board: Float[Array, "corners 3"],
    left: Corners,
    right: Corners,
    *,
    intrinsics: Intrinsics = Intrinsics(),
    shape: tuple[int, int] | None = None,
    sigma: Any = None,
    loss: Any = Quadratic(),
) -> Estimate:
    """Two cameras and their relative pose from images of a planar board.

    Minimizes the whitened reprojection errors of both cameras over both cameras, ``T_left_right`` and the poses
    ``T_left_board`` together: see `calibrate`, and the precision that it needs. A pair in which only one camera sees
    the board is used for that camera.

    Args:
        board: corners in the frame of the board, m, with z = 0.
        left: their pixels in each image of the left camera.
        right: their pixels in the simultaneous image of the right camera.
        intrinsics: parameters that are estimated, of either camera.
        shape: (rows, columns) of the images, for the initial value, and for a fixed principal point.
        sigma: standard deviation of a coordinate of a corner, px; None estimates it from the residuals.
        loss: robust kernel over the two coordinates of a corner, in sigmas.

    Returns:
        Estimate of a `CalibratedStereo`; the tangent is that of the left camera, the right camera, ``T_left_right``,
        and the boards.

    Raises:
        ValueError: if the numbers of corners of board and images differ.

    References:
        Zhang 2000 [T-17]; the rig of thesis figure 2.4 [T-21].

    Example:
        >>> import jax, jax.numpy as jnp, jaxloc as jl
        >>> from jaxloc.refinement.calibration import Corners, Intrinsics, NoLens, calibrate_stereo
        >>> board = jnp.array([[0.1 * x, 0.1 * y, 0.0] for y in range(4) for x in range(5)])
        >>> camera, rig = jl.sensors.Pinhole(500.0, 500.0, 320.0, 240.0), jl.poses.SE3.exp(jnp.eye(6)[0] * 0.1)
        >>> def view(angles):
        ...     pose = jl.poses.SE3.from_euler(jnp.array([-0.2, -0.1, 1.0]), angles[0], angles[1], angles[2])
        ...     right = rig.inverse() @ pose
        ...     return camera.project(pose.apply(board)), camera.project(right.apply(board))
        >>> angles = jnp.array([[0.0, 0.3, 0.2], [0.2, -0.4, 0.1], [0.4, 0.1, -0.5], [0.1, -0.2, 0.4]])
        >>> images = [Corners(side) for side in jax.vmap(view)(angles)]
        >>> fit = calibrate_stereo(board, *images, intrinsics=Intrinsics(NoLens()), sigma=0.1)
        >>> bool(fit.ok), round(float(fit.value.T_left_right.translation[0]), 3)
        (True, 0.1)
    """
    check_corners(board, left.pixels, right.pixels)

    def run(board: Array, left: Corners, right: Corners, sigma: Any, loss: Any) -> Estimate:
        center, sides = center_board(*(finite_views(board, side.pixels, side.valid) for side in (left, right)))
        shifts = jnp.where((sides[0].used() | sides[1].used())[:, None], center[None, :], 0.0)
        return _calibrate(*(prepare(side, intrinsics, shape, loss) for side in sides), sigma, loss, shifts)

    return guarded(is_usable(sigma, board.dtype), run, board, left, right, sigma, loss)


def _calibrate(left: tuple, right: tuple, sigma: Any, loss: Any, shifts: Array) -> Estimate:
    """From parametrization, problem and initial unknowns of either camera; boards move back by their shifts."""
    sides = left, right
    (left_model, left_problem, _), (right_model, right_problem, _) = sides
    single = [_solve_single(problem, initial) for _, problem, initial in sides]
    initial = _join(single, [left_problem.valid, right_problem.valid])
    problem = StereoProblem(
        left_model,
        right_model,
        left_problem.board,
        jnp.concatenate([left_problem.pixels, right_problem.pixels], axis=2),
        jnp.concatenate([left_problem.valid, right_problem.valid], axis=1),
        left_problem.sigma,
        loss,
    )
    found = fit(problem, initial, sigma, LevenbergMarquardt())
    rig = found.value.shared
    value = CalibratedStereo(
        left_model.camera(rig.left),
        right_model.camera(rig.right),
        rig.T_left_right,
        move_boards(found.value.boards, shifts),
    )
    return transform_estimate(
        found, value, shifts, left_model.basis(), right_model.basis(), jnp.eye(SE3.dof, dtype=shifts.dtype)
    )


def _solve_single(problem: CameraProblem, initial: Unknowns) -> Unknowns:
    """Calibration of one camera, for the initial value."""
    frozen = jax.lax.stop_gradient(problem)
    plain = eqx.tree_at(lambda p: p.loss, frozen, Quadratic())
    return solve(plain, initial, solver=LevenbergMarquardt(), max_steps=100).value


def _join(single: list[Unknowns], valid: list[Array]) -> Unknowns:
    """Mean relative pose over boards that both cameras see, and all boards in the left camera's frame."""
    left, right = (unknowns.boards for unknowns in single)
    seen_left, seen_right = (jnp.any(mask, axis=1) for mask in valid)
    both = (seen_left & seen_right).astype(left.translation.dtype)
    relative = jax.vmap(lambda a, b: a @ b.inverse())(left, right)
    count = jnp.maximum(jnp.sum(both), 1.0)
    rotation = jnp.sum(relative.rotation.rotation_matrix * both[:, None, None], axis=0) / count
    u, _, v = _linalg.svd(jnp.where(jnp.sum(both) > 0, rotation, jnp.eye(3, dtype=rotation.dtype)))
    mean = SE3(SO3(matmul(u, v)), jnp.sum(relative.translation * both[:, None], axis=0) / count)
    carried_over = jax.vmap(lambda b: mean @ b)(right)
    only_right = ~seen_left & seen_right

    def choose(a: Array, b: Array) -> Array:
        return jnp.where(only_right.reshape(-1, *([1] * (a.ndim - 1))), b, a)

    boards = jax.tree.map(choose, left, carried_over)
    return Unknowns(Rig(single[0].shared, single[1].shared, mean), boards)
