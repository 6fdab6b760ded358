"""Nonlinear least squares on manifolds: minimization, covariance and implicit derivatives in one call."""

from typing import Any

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float

from jaxloc import _tree as tree
from jaxloc._jit import filter_jit
from jaxloc._linalg import matmul
from jaxloc.poses import tangent_dimension
from jaxloc.solvers.cholesky import factor
from jaxloc.solvers.estimate import Estimate, Status
from jaxloc.solvers.gauss_newton import GaussNewton, Solver, TangentSolver
from jaxloc.solvers.implicit_gradient import Equations, attach_gradient
from jaxloc.solvers.problem import (
    NormalEquations,
    Problem,
    cost_along,
    float_dtype,
    is_quadratic,
    normal_equations,
    sandwich,
)


@filter_jit
def solve(problem: Problem, initial: Any, *, solver: Solver = GaussNewton(), max_steps: int = 50) -> Estimate:
    """Minimizes the robust sum of squares ``sum rho(|r_i|^2)`` of a problem's whitened residuals.

    The state moves on its manifold: poses by retraction, arrays by addition. Derivatives of the value are those of the
    implicit function theorem with the exact Hessian of the objective, robust kernels included, in forward and reverse
    mode; they cost one Hessian of the residual, whatever the number of steps, and are zero where ``ok`` is False. The
    initial value has no influence on the minimum, so its derivative is zero.

    Args:
        problem: the problem to minimize.
        initial: initial value, a pytree with poses and arrays.
        solver: `GaussNewton`, `LevenbergMarquardt` or `Dogleg`.
        max_steps: bound on the number of steps; static.

    Returns:
        The estimate. ``ok`` is False with a `Status` when it has not converged, when the data leave directions
        undetermined, or when values are not finite; value and covariance are finite in any case. The covariance is
        ``(J^T J)^-1`` under the noise model for plain least squares, and the sandwich of M-estimation under robust
        kernels.

    References:
        Design of the solver: Rader, Lyons, Kidger, "Optimistix", 2024. Implicit differentiation of robust problems
        needs the exact Hessian: its Gauss-Newton form is wrong by 16-35 % [K-21, K-71].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> def landmarks(pose, data):
        ...     return (pose.inverse().apply(data["world"]) - data["body"]).T / 0.1
        >>> data = {"world": jnp.array([[1.0, 0.0], [0.0, 1.0], [2.0, 2.0]]),
        ...         "body": jnp.array([[0.0, 0.0], [-1.0, 1.0], [1.0, 2.0]])}
        >>> fit = jl.solvers.solve(jl.solvers.FunctionProblem(landmarks, data), jl.poses.SE2(0.0, 0.0, 0.1))
        >>> bool(fit.ok), round(float(fit.value.x), 3)
        (True, 1.0)
    """
    initial, clean = _finite_initial(initial)
    found, status, num_steps = minimize(problem, initial, solver, max_steps)
    status = jnp.where(clean, status, int(Status.NONFINITE))
    ok = status == int(Status.CONVERGED)
    # NaN in the data would pass to the derivatives through any later mask.
    problem = tree.detach_unless(ok, problem)
    value = attach_gradient(found, StationaryPoint(problem), ok)
    normal = normal_equations(problem, value)
    cost, hessian = tree.finite_or_zero((normal.cost, normal.hessian))
    return Estimate(value, covariance(problem, value, normal, ok), cost, ok, num_steps, status, hessian)


def _detached(values: Any) -> Any:
    return jax.tree.map(lambda leaf: jax.lax.stop_gradient(leaf) if eqx.is_array(leaf) else leaf, values)


def _finite_initial(initial: Any) -> tuple[Any, Bool[Array, ""]]:
    """The initial value without derivative and with non-finite entries replaced, and whether all were finite."""
    moving, rest = eqx.partition(_detached(initial), eqx.is_inexact_array)
    checks = [jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(moving)]
    if not checks:
        raise ValueError("The initial value holds neither poses nor floating-point arrays: there is nothing to move.")
    return eqx.combine(tree.finite_or_zero(moving), rest), jnp.all(jnp.stack(checks))


class _Detached(optx.AbstractAdjoint):
    """Runs the iterations without derivatives; `attach_gradient` adds those of the minimum."""

    def apply(self, primal_fn: Any, rewrite_fn: Any, inputs: Any, tags: Any) -> Any:
        """The plain loop."""
        del rewrite_fn, tags
        return primal_fn((*inputs, _lax_loop))


def _lax_loop(cond_fun: Any, body_fun: Any, init: Any, *, max_steps: int | None) -> Any:
    return eqxi.while_loop(cond_fun, body_fun, init, max_steps=max_steps, kind="lax")


def _residual(moving: Any, args: Any) -> Any:
    problem, rest = args
    return problem.residual(eqx.combine(moving, rest))


def minimize(problem: Problem, initial: Any, solver: Solver, max_steps: int) -> tuple[Any, Array, Array]:
    """Runs the iterations: value, status and number of steps, without derivatives."""
    moving, rest = eqx.partition(initial, eqx.is_inexact_array)
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
        problem: the problem, whitened by its noise model.
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
        result = jnp.where(ok, matmul(inverse, matmul(meat, inverse)), inverse)
    return tree.detach_unless(ok, tree.finite_or_zero(result))


class StationaryPoint(Equations):
    """The equations of a minimum: the gradient of the exact objective along the tangent is zero.

    Attributes:
        problem: what was minimized.
    """

    problem: Problem

    def residual(self, value: Any) -> Float[Array, " d"]:
        """Gradient of the objective, robust kernels included."""
        zero = jnp.zeros(tangent_dimension(value), float_dtype(value))
        return jax.grad(cost_along, argnums=2)(self.problem, value, zero)

    def solve(self, value: Any, right: Float[Array, " d"], ok: Bool[Array, ""]) -> Float[Array, " d"]:
        """By the exact Hessian."""
        return matmul(_inverse(self.problem.hessian(value), ok), right)


def _inverse(hessian: Float[Array, "d d"], ok: Bool[Array, ""]) -> Float[Array, "d d"]:
    """Inverse of the exact Hessian at a minimum (positive definite there), zero where not ``ok``."""
    inverse = factor(jnp.where(ok, hessian, jnp.eye(hessian.shape[0], dtype=hessian.dtype))).inverse()
    return jnp.where(ok, inverse, 0.0)
