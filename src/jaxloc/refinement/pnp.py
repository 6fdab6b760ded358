"""Perspective-n-point (PnP): least-squares pose of a camera from pixels of known points."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxloc._arguments import checked
from jaxloc.poses import SE3
from jaxloc.refinement.reprojection import Reprojection
from jaxloc.sensors import Pinhole
from jaxloc.solvers import Estimate, GaussNewton, Quadratic, Solver, solve


@eqx.filter_jit
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
        when fewer than three independent points are visible, when under plain least squares a point lies behind the
        camera, or when the solver did not converge.

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
    problem = Reprojection(camera, points.T, pixels.T, sigma, usable, loss)
    return solve(problem, initial, solver=solver)


def _usable(valid: Any, first: Array, second: Array) -> tuple[Bool[Array, " n"], Array, Array]:
    """The mask of finite items, and the items with the others replaced by zero."""
    finite = jnp.all(jnp.isfinite(first), axis=1) & jnp.all(jnp.isfinite(second), axis=1)
    usable = finite if valid is None else valid & finite
    return usable, jnp.where(usable[:, None], first, 0.0), jnp.where(usable[:, None], second, 0.0)
