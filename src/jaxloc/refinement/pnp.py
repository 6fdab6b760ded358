"""Perspective-n-point (PnP): least-squares pose of a camera from pixels of known points."""

from typing import Any

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxloc import _tree as tree
from jaxloc._arguments import checked
from jaxloc._jit import filter_jit
from jaxloc.beliefs.square_root import product
from jaxloc.beliefs.validity import positive
from jaxloc.poses import SE3
from jaxloc.poses.lie_group import skew
from jaxloc.refinement.reprojection import Reprojection
from jaxloc.sensors import Pinhole
from jaxloc.solvers import Estimate, GaussNewton, Quadratic, Solver, Status, solve


@filter_jit
@checked
def refine_pose(
    camera: Pinhole,
    points_world: Float[Array, "n 3"],
    pixels: Float[Array, "n 2"],
    initial: SE3,
    *,
    loss: Any = Quadratic(),
    valid: Bool[Array, " n"] | None = None,
    sigma: Any = 1.0,
    solver: Solver = GaussNewton(),
) -> Estimate:
    """Pose of a camera from pixels of known points and an initial pose (PnP refinement).

    Minimizes ``sum rho(|project(T^-1 X_i) - z_i|^2 / sigma^2)`` over the pose ``T = T_world_camera``.

    Args:
        camera: intrinsics and lens.
        points_world: "n 3", world frame, m.
        pixels: "n 2" (u right, v down), px.
        initial: the camera's pose ``T_world_camera`` (camera to world; the inverse of OpenCV's rvec, tvec).
        loss: robust kernel, in sigmas.
        valid: points that are used; others may hold any numbers, nan too.
        sigma: standard deviation of a pixel coordinate, px.
        solver: of the minimization.

    Returns:
        Estimate of ``T_world_camera`` with covariance in its tangent (right perturbation: camera axes). ``ok`` is False
        when fewer than three independent points are visible, when a standard deviation exceeds a radian or the distance
        (as of points on a line), when coordinates are so large that their rounding exceeds `sigma`, when under plain
        least squares a point lies behind the camera, or when the solver did not converge.

    References:
        Lepetit and Fua, "Monocular model-based 3D tracking of rigid objects", 2005, section 2.4 [K-56, K-73].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> camera = jl.sensors.Pinhole(500.0, 500.0, 320.0, 240.0)
        >>> points = jnp.array([[0.0, 0.0, 5.0], [1.0, 0.0, 6.0], [0.0, 1.0, 7.0], [1.0, 1.0, 5.0]])
        >>> pixels = camera.project(points - jnp.array([[0.2, 0.0, 0.0]]))
        >>> fit = jl.refinement.pnp.refine_pose(camera, points, pixels, jl.poses.SE3.identity())
        >>> bool(fit.ok), fit.value.translation.round(3).tolist()[0]
        (True, 0.20000000298023224)
    """
    usable, points, pixels = _usable(valid, points_world, pixels)
    sigma = jnp.asarray(sigma, pixels.dtype)
    weights = _weights(points, usable, initial)
    mean = jnp.sum(weights[:, None] * lax.stop_gradient(points), axis=0)
    center = _seen_from(initial, mean)
    problem = Reprojection(camera, points.T, pixels.T, sigma, usable, loss, center)
    fit = solve(problem, _shifted(initial, center), solver=solver)
    wrong = (
        (~(positive(sigma) & tree.all_finite(initial)), Status.INADMISSIBLE),
        (_is_imprecise(fit, points, weights, usable), Status.IMPRECISE),
        (_is_vague(fit, mean, _shifted(fit.value, -center)), Status.RANK_DEFICIENT),
    )
    return _refuse(_about_camera(fit, center), wrong)


def _weights(points: Float[Array, "n 3"], usable: Bool[Array, " n"], pose: SE3) -> Float[Array, " n"]:
    """What each point tells about the position, as a share, without derivatives; zero for points that are not usable.

    That falls with the square of the distance: a point at the horizon must not draw the center there, at which single
    precision could not tell positions of the camera apart.
    """
    squared = jnp.sum(lax.stop_gradient(points - pose.translation[None, :]) ** 2, axis=1)
    floor = float(jnp.finfo(points.dtype).eps) ** 2
    weights = jnp.where(usable & jnp.isfinite(squared), 1.0 / jnp.maximum(squared, floor), 0.0)
    total = jnp.sum(weights)
    return lax.stop_gradient(weights / jnp.where(total > 0.0, total, 1.0))


def _seen_from(pose: SE3, point: Float[Array, "3"]) -> Float[Array, "3"]:
    """A point in the frame of a pose, without derivatives; zero where it is not finite."""
    seen = lax.stop_gradient(pose.inverse().apply(point[None])[0])
    return jnp.where(jnp.all(jnp.isfinite(seen)), seen, 0.0)


def _shifted(pose: SE3, offset: Float[Array, "3"]) -> SE3:
    """The pose of a frame of the same axes at a point of the given one."""
    return SE3(pose.rotation, pose.apply(offset[None])[0])


def _is_vague(fit: Estimate, mean: Float[Array, "3"], camera: SE3) -> Bool[Array, ""]:
    """Whether nothing is known of the direction or the distance: of points on a line, for instance.

    The rank depends on rounding, and so on the precision; standard deviations do not. Beyond a radian, or the distance
    of the points, the linearization means nothing. The fit is that of the frame at the center.
    """
    variance, offset = lax.stop_gradient((jnp.diagonal(fit.covariance), mean - camera.translation))
    return (jnp.sum(variance[3:]) > 1.0) | (jnp.sum(variance[:3]) > jnp.sum(offset * offset))


def _is_imprecise(
    fit: Estimate, points: Float[Array, "n 3"], weights: Float[Array, " n"], usable: Bool[Array, " n"]
) -> Bool[Array, ""]:
    """Whether rounding of the points moves their pixels by more than a standard deviation, in the root mean square.

    Points and camera move pixels alike: the information about the position, which does not depend on the frame's
    center, is the sum over the points of what a displacement does to whitened residuals; the weights divide it among
    the points.
    """
    # Variance of a number that was rounded to the nearest one, for each of the three coordinates.
    rounding = jnp.max(jnp.abs(points), axis=1, initial=0.0) * float(jnp.finfo(points.dtype).eps)
    variance = jnp.sum(weights * rounding**2) / 12.0
    information = jnp.sum(jnp.diagonal(fit.information)[:3])
    return lax.stop_gradient(variance * information > 2.0 * jnp.sum(usable, dtype=points.dtype))


def _refuse(fit: Estimate, wrong: tuple[tuple[Bool[Array, ""], Status], ...]) -> Estimate:
    """The estimate, with the first of the statuses whose condition holds."""
    conditions, reasons = zip(*wrong, strict=True)
    status = jnp.select(conditions, [jnp.asarray(int(reason), fit.status.dtype) for reason in reasons], fit.status)
    ok = fit.ok & (status == fit.status)
    found = fit.value, fit.covariance, fit.cost, fit.information
    value, covariance, cost, information = tree.detach_unless(ok, found)
    return Estimate(value, covariance, cost, ok, fit.num_steps, jnp.where(fit.ok, status, fit.status), information)


def _about_camera(fit: Estimate, center: Float[Array, "3"]) -> Estimate:
    """The estimate of the camera's pose from that of the frame at the center."""
    eye, zero = jnp.eye(3, dtype=center.dtype), jnp.zeros((3, 3), center.dtype)
    turned = jnp.block([[eye, skew(center)], [zero, eye]])
    back = jnp.block([[eye, -skew(center)], [zero, eye]])
    covariance = product(turned, product(fit.covariance, turned.T))
    information = product(back.T, product(fit.information, back))
    value = _shifted(fit.value, -center)
    return Estimate(value, covariance, fit.cost, fit.ok, fit.num_steps, fit.status, information)


def _usable(valid: Any, first: Array, second: Array) -> tuple[Bool[Array, " n"], Array, Array]:
    """The mask of finite items, and the items with the others replaced by zero."""
    finite = jnp.all(jnp.isfinite(first), axis=1) & jnp.all(jnp.isfinite(second), axis=1)
    usable = finite if valid is None else valid & finite
    return usable, jnp.where(usable[:, None], first, 0.0), jnp.where(usable[:, None], second, 0.0)
