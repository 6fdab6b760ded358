"""Solving a problem: one call that minimizes, tells how sure the answer is, and differentiates through it."""

from typing import Any

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float

from jaxloc._linalg import matmul
from jaxloc.poses import retract, tangent_dimension
from jaxloc.solvers.cholesky import factor
from jaxloc.solvers.estimate import Estimate, Status
from jaxloc.solvers.gauss_newton import GaussNewton, Solver, TangentSolver
from jaxloc.solvers.problem import (
    NormalEquations,
    Problem,
    cost_along,
    float_dtype,
    is_quadratic,
    normal_equations,
    sandwich,
)


@eqx.filter_jit
def solve(problem: Problem, initial: Any, *, solver: Solver = GaussNewton(), max_steps: int = 50) -> Estimate:
    """Minimizes the robust sum of squares ``sum rho(|r_i|^2)`` of a problem's whitened residuals.

    The state moves on its manifold: poses by retraction, arrays by addition. Derivatives of the value are those of the
    implicit function theorem with the exact Hessian of the objective, robust kernels included, in forward and reverse
    mode; they cost one Hessian of the residual, whatever the number of steps, and are zero where ``ok`` is False. The
    start has no influence on the minimum, so its derivative is zero.

    Args:
        problem: what to minimize.
        initial: where to start, a pytree with poses and arrays.
        solver: `GaussNewton`, `LevenbergMarquardt` or `Dogleg`.
        max_steps: bound on the number of steps; static.

    Returns:
        The estimate. ``ok`` is False with a `Status` when it has not converged, when the data leave directions
        undetermined, or when numbers are not finite; value and covariance are finite in any case. The covariance is
        ``(J^T J)^-1`` under the noise model for plain least squares, and the sandwich of M-estimation under robust
        kernels.

    References:
        Design of the solver: Rader, Lyons, Kidger, "Optimistix", 2024. Implicit differentiation of robust problems
        needs the exact Hessian: its Gauss-Newton form is wrong by 16-35 % [K-21, K-71].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> def landmarks(pose, data):
        ...     return (pose.inverse().apply(data["world"]) - data["seen"]).T / 0.1
        >>> data = {"world": jnp.array([[1.0, 0.0], [0.0, 1.0], [2.0, 2.0]]),
        ...         "seen": jnp.array([[0.0, 0.0], [-1.0, 1.0], [1.0, 2.0]])}
        >>> fit = jl.solvers.solve(jl.solvers.FunctionProblem(landmarks, data), jl.poses.SE2(0.0, 0.0, 0.1))
        >>> bool(fit.ok), round(float(fit.value.x), 3)
        (True, 1.0)
    """
    start, clean = _finite_start(initial)
    found, status, num_steps = minimize(problem, start, solver, max_steps)
    status = jnp.where(clean, status, int(Status.NONFINITE))
    ok = status == int(Status.CONVERGED)
    # Derivatives of a problem full of nan are cut at its door.
    problem = trusted(problem, ok)
    value = attach_gradient(found, problem, ok)
    normal = normal_equations(problem, value)
    spread = covariance(problem, value, normal, ok)
    return Estimate(value, spread, _safe(normal.cost), ok, num_steps, status, _safe(normal.hessian))


def trusted(tree: Any, ok: Bool[Array, ""]) -> Any:
    """The tree itself, its derivatives cut (also those that are nan) where ``ok`` is False."""

    def cut(leaf: Any) -> Any:
        return jnp.where(ok, leaf, jax.lax.stop_gradient(leaf)) if eqx.is_inexact_array(leaf) else leaf

    return jax.tree.map(cut, tree)


def _detached(tree: Any) -> Any:
    return jax.tree.map(lambda leaf: jax.lax.stop_gradient(leaf) if eqx.is_array(leaf) else leaf, tree)


def _finite_start(initial: Any) -> tuple[Any, Bool[Array, ""]]:
    """The start without gradient, with anything not finite replaced, and whether nothing had to be."""
    start = _detached(initial)
    moving, rest = eqx.partition(start, eqx.is_inexact_array)
    checks = [jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(moving)]
    if not checks:
        raise ValueError("The start holds neither poses nor floating arrays: there is nothing to move.")
    return eqx.combine(jax.tree.map(_safe, moving), rest), jnp.all(jnp.stack(checks))


def _safe(leaf: Array) -> Array:
    return jnp.where(jnp.isfinite(leaf), leaf, 0.0)


class _Detached(optx.AbstractAdjoint):
    """Runs the iterations without derivatives: `attach_gradient` gives the answer its own."""

    def apply(self, primal_fn: Any, rewrite_fn: Any, inputs: Any, tags: Any) -> Any:
        """The plain loop."""
        del rewrite_fn, tags
        return primal_fn((*inputs, _lax_loop))


def _lax_loop(cond_fun: Any, body_fun: Any, init: Any, *, max_steps: int | None) -> Any:
    return eqxi.while_loop(cond_fun, body_fun, init, max_steps=max_steps, kind="lax")


def _residual(moving: Any, args: Any) -> Any:
    problem, rest = args
    return problem.residual(eqx.combine(moving, rest))


def minimize(problem: Problem, start: Any, solver: Solver, max_steps: int) -> tuple[Any, Array, Array]:
    """The iterations: value, status and number of steps, without derivatives."""
    moving, rest = eqx.partition(start, eqx.is_inexact_array)
    dtype = jnp.result_type(*jax.tree.leaves(moving))
    solution = optx.least_squares(
        _residual,
        TangentSolver(solver, dtype),
        moving,
        (_detached(problem), rest),
        max_steps=max_steps,
        adjoint=_Detached(),
        throw=False,
    )
    return eqx.combine(solution.value, rest), solution.stats["status"], solution.stats["num_steps"]


def covariance(problem: Problem, value: Any, normal: NormalEquations, ok: Bool[Array, ""]) -> Float[Array, "d d"]:
    """Covariance of a minimum in its tangent space, finite also where directions are undetermined.

    Args:
        problem: the problem, in sigmas of its noise model.
        value: the minimum.
        normal: the normal equations there.
        ok: where False, derivatives are cut.

    Returns:
        ``(J^T J)^-1`` for plain least squares; ``A^-1 B A^-1`` under robust kernels.
    """
    if is_quadratic(problem.loss):
        result = factor(normal.hessian).inverse()
    else:
        bread, meat = sandwich(problem, value)
        inverse = factor(bread).inverse()
        spread = matmul(inverse, matmul(meat, inverse))
        result = jnp.where(ok, spread, inverse)
    return trusted(_safe(result), ok)


@eqx.filter_custom_jvp
def attach_gradient(value: Any, problem: Problem, ok: Bool[Array, ""]) -> Any:
    """The value itself, with the derivative that a minimum of the problem has (implicit function theorem).

    With ``g(d, p)`` the gradient of the exact objective along the tangent at the minimum, ``g(0, p) = 0`` gives
    ``dd = -(dg/dd)^-1 (dg/dp) dp``. The rule calls itself on its own output, so that higher derivatives are right too.

    Args:
        value: a minimum.
        problem: of what.
        ok: where False, the derivative is zero.

    Returns:
        The value.
    """
    del problem, ok
    return value


@attach_gradient.def_jvp
def _attach_gradient_jvp(primals: Any, tangents: Any) -> tuple[Any, Any]:
    value, problem, ok = primals
    _, problem_tangent, _ = tangents
    value = attach_gradient(value, problem, ok)
    is_none = lambda node: node is None  # noqa: E731
    moving = jax.tree.map(
        lambda tangent, leaf: leaf if tangent is not None else None, problem_tangent, problem, is_leaf=is_none
    )
    fixed = jax.tree.map(
        lambda tangent, leaf: leaf if tangent is None else None, problem_tangent, problem, is_leaf=is_none
    )
    zero = jnp.zeros(tangent_dimension(value), float_dtype(value))

    def slope(delta: Float[Array, " d"], perturbed: Any) -> Float[Array, " d"]:
        return jax.grad(cost_along, argnums=2)(eqx.combine(perturbed, fixed), value, delta)

    _, change = jax.jvp(lambda perturbed: slope(zero, perturbed), (moving,), (problem_tangent,))
    delta = jnp.where(ok, -matmul(_inverse(problem.hessian(value), ok), change), 0.0)
    arrays, rest = eqx.partition(value, eqx.is_inexact_array)
    _, tangent = jax.jvp(
        lambda d: eqx.filter(retract(eqx.combine(arrays, rest), d), eqx.is_inexact_array), (zero,), (delta,)
    )
    return value, tangent


def _inverse(hessian: Float[Array, "d d"], ok: Bool[Array, ""]) -> Float[Array, "d d"]:
    """Inverse of the exact Hessian at a minimum (positive definite there), zero where it is not to be trusted."""
    inverse = factor(jnp.where(ok, hessian, jnp.eye(hessian.shape[0], dtype=hessian.dtype))).inverse()
    return jnp.where(ok, inverse, 0.0)
