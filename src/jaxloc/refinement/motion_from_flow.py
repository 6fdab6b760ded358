"""Camera velocity from optical flow of features, with and without depth.

A static point at ``(x, y)`` (normalized, x right, y down) and depth Z moves in the image of a camera with the twist
(v, w), camera axes, by

    ``flow = A v / Z + B w``,  ``A = [[-1, 0, x], [0, -1, y]]``,
    ``B = [[x y, -(1 + x^2), y], [1 + y^2, -x y, -x]]``.

Depth and translation enter by their quotient only: twice the depth with twice the translation gives the same image, so
that without depth the rotation and the direction of translation are observable. The rotational part does not depend on
depth. Over a narrow field of view B is almost constant and similar to a translation before a wall; a wide one
distinguishes them.

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

from jaxloc import _tree as tree
from jaxloc._arguments import checked
from jaxloc._jit import filter_jit
from jaxloc._linalg import matmul
from jaxloc.beliefs.validity import positive
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
from jaxloc.solvers.estimate import guarded
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

_DIRECTIONS = 96  # initial values on a half-sphere, 15 degrees apart


@filter_jit
@checked
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
        depth: along the optical axis, m, for example by stereo; without it the speed is unobservable.
        sigma: standard deviation of a component of the flow, 1/s: a number or one a point.
        valid: points that are used. Non-finite values, and depths and sigmas that are not positive never are.
        loss: robust kernel over the two components of a point.

    Returns:
        Estimate of the twist "6" (v, w) in the camera's axes, m/s and rad/s. ``ok`` is False when the points do not
        determine it, as two points.

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
    return guarded(jnp.array(True), _twist, points, flow, depth, sigma, valid, loss)


def _twist(points: Array, flow: Array, depth: Array, sigma: Any, valid: Any, loss: Any) -> Estimate:
    usable = jnp.isfinite(depth) & (depth > 0)
    points, flow, whitening = _usable(points, flow, sigma, usable if valid is None else usable & valid)
    inverse = jnp.where(whitening > 0, 1.0 / jnp.where(whitening > 0, depth, 1.0), 0.0)
    linear, angular = flow_parts(points)
    interaction = jnp.concatenate([linear * inverse[None, None, :], angular])
    return _linear(FlowOfTwist(interaction, flow, whitening, loss))


@filter_jit
@checked
def rotation_from_flow(
    points: Float[Array, "n 2"],
    flow: Float[Array, "n 2"],
    *,
    sigma: Any = 1.0,
    valid: Bool[Array, " n"] | None = None,
    loss: Any = Quadratic(),
) -> Estimate:
    """Angular velocity of a camera under pure rotation or of a distant scene, independent of depth.

    Args:
        points: normalized coordinates.
        flow: their velocities, 1/s.
        sigma: standard deviation of a component of the flow, 1/s.
        valid: points that are used.
        loss: robust kernel.

    Returns:
        Estimate of the angular velocity "3", camera axes, rad/s; correct only without translation.

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
    return guarded(jnp.array(True), _rotation, points, flow, sigma, valid, loss)


def _rotation(points: Array, flow: Array, sigma: Any, valid: Any, loss: Any) -> Estimate:
    points, flow, whitening = _usable(points, flow, sigma, valid)
    return _linear(FlowOfTwist(flow_parts(points)[1], flow, whitening, loss))


@filter_jit
@checked
def motion_from_flow(
    points: Float[Array, "n 2"],
    flow: Float[Array, "n 2"],
    *,
    sigma: Any = 1.0,
    valid: Bool[Array, " n"] | None = None,
    loss: Any = Quadratic(),
) -> Estimate:
    """Direction of translation and angular velocity of a camera, from flow without depth.

    Minimizes the flow across the lines to the focus of expansion, with the depths eliminated, from the best of many
    initial directions, each with its best rotation.

    Args:
        points: normalized coordinates.
        flow: their velocities, 1/s.
        sigma: standard deviation of a component of the flow, 1/s.
        valid: points that are used; five at least.
        loss: robust kernel.

    Returns:
        Estimate of `FreeMotion`; its covariance is in (tangent of the direction, rotation). The sign of the direction
        is the one with most points in front of the camera. ``ok`` is False when the flow does not determine it, as
        without translation.

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
    return guarded(jnp.array(True), _direction_and_rotation, points, flow, sigma, valid, loss)


def _direction_and_rotation(points: Array, flow: Array, sigma: Any, valid: Any, loss: Any) -> Estimate:
    points, flow, whitening = _usable(points, flow, sigma, valid)
    problem = DirectionalFlow(points, flow, whitening, loss)
    fixed = jax.tree.map(lambda leaf: lax.stop_gradient(leaf) if eqx.is_inexact_array(leaf) else leaf, problem)
    candidates = _half_sphere(flow.dtype)
    rotations, costs = jax.vmap(fixed.rotation_for)(candidates)
    best = jnp.argmin(costs)
    initial = FreeMotion(Direction(candidates[best]), rotations[best])
    found = solve(problem, initial, solver=LevenbergMarquardt())
    behind = fixed.excess_in_front(found.value) < 0
    return _reverse_direction(found, jnp.where(behind, -1.0, 1.0).astype(flow.dtype), found.value)


def _linear(problem: FlowOfTwist) -> Estimate:
    """The minimum: in one step for plain least squares, whose derivatives are those of the step itself."""
    start = jnp.zeros(problem.interaction.shape[0], problem.flow.dtype)
    if not is_quadratic(problem.loss):
        return solve(problem, start, solver=GaussNewton())
    normal = normal_equations(problem, start)
    root = factor(normal.hessian)
    ok = ~root.deficient
    value = tree.detach_unless(ok, -root.solve(normal.gradient))
    cost = 0.5 * jnp.sum(problem.residual(value) ** 2)
    status = jnp.where(ok, int(Status.CONVERGED), int(Status.RANK_DEFICIENT)).astype(int)
    return Estimate(value, tree.detach_unless(ok, root.inverse()), cost, ok, jnp.zeros((), int), status, normal.hessian)


def _reverse_direction(found: Estimate, sign: Float[Array, ""], value: FreeMotion) -> Estimate:
    """The estimate with its direction reversed for a negative sign, and the covariance in the new tangent."""
    reversed_ = Direction(sign * value.direction.vector)
    change = matmul(reversed_.basis().T, sign * value.direction.basis())
    size = found.covariance.shape[0]
    whole = jnp.eye(size, dtype=change.dtype).at[:2, :2].set(change)
    motion = FreeMotion(reversed_, value.angular_velocity)
    covariance = matmul(whole, matmul(found.covariance, whole.T))
    information = matmul(whole, matmul(found.information, whole.T))
    return eqx.tree_at(lambda e: (e.value, e.covariance, e.information), found, (motion, covariance, information))


def _half_sphere(dtype: Any) -> Float[Array, "96 3"]:
    """Directions evenly distributed over the forward half-sphere; the other half has the same flow."""
    index = jnp.arange(_DIRECTIONS, dtype=dtype)
    z = (index + 0.5) / _DIRECTIONS
    radius, angle = jnp.sqrt(1.0 - z * z), index * (math.pi * (3.0 - math.sqrt(5.0)))
    return jnp.stack([radius * jnp.cos(angle), radius * jnp.sin(angle), z], axis=1)


def _usable(points: Array, flow: Array, sigma: Any, valid: Any) -> tuple[Array, Array, Array]:
    """Points and flow as "2 n" with non-finite values replaced, and the whitening, zero for masked points."""
    usable = jnp.all(jnp.isfinite(points), axis=1) & jnp.all(jnp.isfinite(flow), axis=1)
    usable = usable if valid is None else usable & valid
    sigmas = jnp.broadcast_to(jnp.asarray(sigma, flow.dtype), usable.shape)
    usable = usable & positive(sigmas)
    whitening = jnp.where(usable, 1.0 / jnp.where(usable, sigmas, 1.0), 0.0)
    return jnp.where(usable[None, :], points.T, 0.0), jnp.where(usable[None, :], flow.T, 0.0), whitening
