"""The velocity of a camera from the velocities of features in its image, with depth and without.

A static point at ``(x, y)`` (normalized, x right, y down) and depth Z moves in the image of a camera with the twist
(v, w), in the camera's own axes, by

    ``flow = A v / Z + B w``,  ``A = [[-1, 0, x], [0, -1, y]]``,
    ``B = [[x y, -(1 + x^2), y], [1 + y^2, -x y, -x]]``.

Depth and translation enter by their quotient only: twice the depth with twice the translation is the same image, so
without depth a camera tells the direction of its translation, and its rotation. The part of a rotation does not know
depth at all. Over a narrow field of view B is almost constant and looks like a translation before a wall: a wide one
tells them apart.

References:
    A. Kelly, *Mobile Robotics*, lecture 9.2.4.3.1 and 9.2.4.3.3 [K-78, K-87...K-90]; Longuet-Higgins and Prazdny, "The
    interpretation of a moving retinal image", Proc. R. Soc. 1980.
"""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxloc._linalg import matmul
from jaxloc.poses import Direction
from jaxloc.refinement.interaction_matrix import (
    DirectionalFlow,
    FlowOfTwist,
    FreeMotion,
    JointFlow,
    TwistAndDepths,
    flow_parts,
    interaction_matrix,
)
from jaxloc.solvers import Estimate, GaussNewton, LevenbergMarquardt, Quadratic, Status, solve
from jaxloc.solvers.cholesky import factor
from jaxloc.solvers.least_squares import trusted
from jaxloc.solvers.problem import is_quadratic, normal_equations

__all__ = [
    "DirectionalFlow",
    "FlowOfTwist",
    "FreeMotion",
    "JointFlow",
    "TwistAndDepths",
    "interaction_matrix",
    "motion_from_flow",
    "rotation_from_flow",
    "twist_from_flow",
]

_DIRECTIONS = 96  # half a sphere of starts, 15 degrees apart


@eqx.filter_jit
def twist_from_flow(
    points: Float[Array, "n 2"],
    flow: Float[Array, "n 2"],
    depth: Float[Array, " n"],
    *,
    sigma: Any = 1.0,
    valid: Bool[Array, " n"] | None = None,
    loss: Any = Quadratic(),
) -> Estimate:
    """Velocity of a camera from flow at points of known depth, by linear least squares.

    Args:
        points: normalized coordinates (x right, y down).
        flow: their velocities, 1/s.
        depth: along the optical axis, m, as stereo tells it; without it a camera cannot tell its speed.
        sigma: standard deviation of a component of the flow, 1/s: a number or one a point.
        valid: points that count. Numbers that are not finite, and depths that are not positive, never do.
        loss: robust kernel over the two components of a point.

    Returns:
        Estimate of the twist "6" (v, w) in the camera's axes, m/s and rad/s. ``ok`` is False when the points leave a
        direction open, as two points do.

    References:
        KELLY 9.2.4.3.1, 9.2.4.3.3 [K-78, K-87].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> from jaxloc.refinement.motion_from_flow import interaction_matrix, twist_from_flow
        >>> points, depth = jnp.array([[0.3, 0.0], [-0.2, 0.4], [0.1, -0.3]]), jnp.array([2.0, 3.0, 5.0])
        >>> flow = interaction_matrix(points, depth) @ jnp.array([0.0, 0.0, 1.0, 0.0, 0.1, 0.0])
        >>> fit = twist_from_flow(points, flow, depth)
        >>> bool(fit.ok), round(float(fit.value[2]), 3), round(float(fit.value[4]), 3)
        (True, 1.0, 0.1)
    """
    usable = jnp.isfinite(depth) & (depth > 0)
    points, flow, whitening = _usable(points, flow, sigma, usable if valid is None else usable & valid)
    inverse = jnp.where(whitening > 0, 1.0 / jnp.where(whitening > 0, depth, 1.0), 0.0)
    linear, angular = flow_parts(points)
    interaction = jnp.concatenate([linear * inverse[None, None, :], angular])
    return _linear(FlowOfTwist(interaction, flow, whitening, loss))


@eqx.filter_jit
def rotation_from_flow(
    points: Float[Array, "n 2"],
    flow: Float[Array, "n 2"],
    *,
    sigma: Any = 1.0,
    valid: Bool[Array, " n"] | None = None,
    loss: Any = Quadratic(),
) -> Estimate:
    """Angular velocity of a camera that turns on the spot, or looks at things far away: depth has no part in it.

    Args:
        points: normalized coordinates.
        flow: their velocities, 1/s.
        sigma: standard deviation of a component of the flow, 1/s.
        valid: points that count.
        loss: robust kernel.

    Returns:
        Estimate of the angular velocity "3", camera axes, rad/s; right only if the camera does not travel.

    References:
        KELLY 9.2.4.3.3: orientation change can be measured without knowing depth, "if you knew the motion was
        rotation" [K-89].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> from jaxloc.refinement.motion_from_flow import interaction_matrix, rotation_from_flow
        >>> points = jnp.array([[0.3, 0.0], [-0.2, 0.4]])
        >>> flow = interaction_matrix(points, jnp.array([1.0, 9.0])) @ jnp.array([0.0, 0.0, 0.0, 0.1, 0.2, 0.3])
        >>> [round(float(w), 3) for w in rotation_from_flow(points, flow).value]
        [0.1, 0.2, 0.3]
    """
    points, flow, whitening = _usable(points, flow, sigma, valid)
    return _linear(FlowOfTwist(flow_parts(points)[1], flow, whitening, loss))


@eqx.filter_jit
def motion_from_flow(
    points: Float[Array, "n 2"],
    flow: Float[Array, "n 2"],
    *,
    sigma: Any = 1.0,
    valid: Bool[Array, " n"] | None = None,
    loss: Any = Quadratic(),
) -> Estimate:
    """Direction of translation and angular velocity of a camera, from flow without depth.

    Minimizes the flow across the lines to the focus of expansion, the depths eliminated; starts from the best of many
    directions, each with the rotation that suits it.

    Args:
        points: normalized coordinates.
        flow: their velocities, 1/s.
        sigma: standard deviation of a component of the flow, 1/s.
        valid: points that count; five at least.
        loss: robust kernel.

    Returns:
        Estimate of `FreeMotion`; its covariance is in (tangent of the direction, rotation). The sign of the direction
        is the one with most points ahead of the camera. ``ok`` is False when the flow does not tell, as that of a
        camera that only turns.

    References:
        KELLY 9.2.4.3.3 [K-88, K-89, K-90]; Heeger and Jepson, "Subspace methods for recovering rigid motion", IJCV
        1992.

    Example:
        >>> import jax, jax.numpy as jnp, jaxloc as jl
        >>> from jaxloc.refinement.motion_from_flow import interaction_matrix, motion_from_flow
        >>> a, b = jax.random.split(jax.random.key(0))
        >>> points = jax.random.uniform(a, (30, 2), minval=-0.7, maxval=0.7)
        >>> depth = jax.random.uniform(b, (30,), minval=2.0, maxval=9.0)
        >>> flow = interaction_matrix(points, depth) @ jnp.array([0.0, 0.6, 0.8, 0.0, 0.1, 0.0])
        >>> fit = motion_from_flow(points, flow, sigma=1e-3)
        >>> bool(fit.ok), [round(float(x), 2) for x in fit.value.direction.vector[1:]]
        (True, [0.6, 0.8])
    """
    points, flow, whitening = _usable(points, flow, sigma, valid)
    problem = DirectionalFlow(points, flow, whitening, loss)
    fixed = jax.tree.map(lambda leaf: lax.stop_gradient(leaf) if eqx.is_inexact_array(leaf) else leaf, problem)
    candidates = _half_sphere(flow.dtype)
    rotations, costs = jax.vmap(fixed.rotation_for)(candidates)
    best = jnp.argmin(costs)
    start = FreeMotion(Direction(candidates[best]), rotations[best])
    found = solve(problem, start, solver=LevenbergMarquardt())
    behind = fixed.ahead(found.value) < 0
    return _pointed(found, jnp.where(behind, -1.0, 1.0).astype(flow.dtype), found.value)


def _linear(problem: FlowOfTwist) -> Estimate:
    """The minimum: in one step for plain least squares, whose derivatives are those of the step itself."""
    start = jnp.zeros(problem.interaction.shape[0], problem.flow.dtype)
    if not is_quadratic(problem.loss):
        return solve(problem, start, solver=GaussNewton())
    normal = normal_equations(problem, start)
    root = factor(normal.hessian)
    ok = ~root.deficient
    value = trusted(-root.solve(normal.gradient), ok)
    cost = 0.5 * jnp.sum(problem.residual(value) ** 2)
    status = jnp.where(ok, int(Status.CONVERGED), int(Status.RANK_DEFICIENT)).astype(int)
    return Estimate(value, trusted(root.inverse(), ok), cost, ok, jnp.zeros((), int), status, normal.hessian)


def _pointed(found: Estimate, sign: Float[Array, ""], value: FreeMotion) -> Estimate:
    """The estimate with its direction turned round where the sign says so, the covariance in the tangent there."""
    turned = Direction(sign * value.direction.vector)
    change = matmul(turned.basis().T, sign * value.direction.basis())
    size = found.covariance.shape[0]
    whole = jnp.eye(size, dtype=change.dtype).at[:2, :2].set(change)
    motion = FreeMotion(turned, value.angular_velocity)
    covariance = matmul(whole, matmul(found.covariance, whole.T))
    information = matmul(whole, matmul(found.information, whole.T))
    return eqx.tree_at(lambda e: (e.value, e.covariance, e.information), found, (motion, covariance, information))


def _half_sphere(dtype: Any) -> Float[Array, "96 3"]:
    """Directions spread evenly over the half that looks ahead: the other half has the same flow."""
    index = jnp.arange(_DIRECTIONS, dtype=dtype)
    z = (index + 0.5) / _DIRECTIONS
    radius, angle = jnp.sqrt(1.0 - z * z), index * (math.pi * (3.0 - math.sqrt(5.0)))
    return jnp.stack([radius * jnp.cos(angle), radius * jnp.sin(angle), z], axis=1)


def _usable(points: Array, flow: Array, sigma: Any, valid: Any) -> tuple[Array, Array, Array]:
    """Points and flow as "2 n" with bad numbers replaced, and the whitening, zero for points that do not count."""
    usable = jnp.all(jnp.isfinite(points), axis=1) & jnp.all(jnp.isfinite(flow), axis=1)
    usable = usable if valid is None else usable & valid
    sigmas = jnp.broadcast_to(jnp.asarray(sigma, flow.dtype), usable.shape)
    whitening = jnp.where(usable, 1.0 / jnp.where(usable, sigmas, 1.0), 0.0)
    return jnp.where(usable[None, :], points.T, 0.0), jnp.where(usable[None, :], flow.T, 0.0), whitening
