"""Graduated non-convexity: robust least squares from a poor initial value, by kernels of decreasing scale."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxloc._jit import filter_jit
from jaxloc.solvers.estimate import Estimate
from jaxloc.solvers.gauss_newton import GaussNewton, Solver
from jaxloc.solvers.least_squares import minimize, solve
from jaxloc.solvers.problem import Problem
from jaxloc.solvers.robust_kernels import Loss


@filter_jit
def solve_graduated(
    problem: Problem,
    initial: Any,
    *,
    factors: tuple[float, ...] = (16.0, 8.0, 4.0, 2.0),
    steps_each: int = 2,
    solver: Solver = GaussNewton(),
    max_steps: int = 50,
) -> Estimate:
    """Minimizes a robust problem by a sequence of kernels of decreasing scale.

    A redescending kernel may have a local minimum at every group of consistent outliers. With its scale multiplied by a
    large factor the objective is nearly convex; a few steps at each smaller factor track its minimum.

    Args:
        problem: a problem whose field ``loss`` holds its kernels.
        initial: initial value.
        factors: scale factors, descending; 1 is added at the end.
        steps_each: solver steps at each factor.
        solver: `GaussNewton`, `LevenbergMarquardt` or `Dogleg`.
        max_steps: bound on the steps of the last stage.

    Returns:
        The estimate of the problem itself, as `solve` gives it; ``num_steps`` counts the last stage.

    References:
        Blake and Zisserman, "Visual Reconstruction", 1987; Yang et al., "Graduated non-convexity for robust spatial
        perception", RA-L 2020 [K-60].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> def deviations(state, data):
        ...     return state - data
        >>> data = jnp.array([1.0, 1.1, 0.9, 1.05, 30.0, 40.0])
        >>> problem = jl.solvers.FunctionProblem(deviations, data, jl.solvers.GemanMcClure(1.0))
        >>> round(float(jl.solvers.solve_graduated(problem, jnp.array(20.0)).value), 2)
        1.01
    """
    is_loss = lambda node: isinstance(node, Loss)  # noqa: E731

    def stage(value: Any, factor: Any) -> tuple[Any, None]:
        widened = jax.tree.map(lambda kernel: kernel.widened(factor), problem.loss, is_leaf=is_loss)
        wide = eqx.tree_at(lambda p: p.loss, problem, widened)
        return minimize(wide, value, solver, steps_each)[0], None

    initial = jax.tree.map(lambda leaf: jax.lax.stop_gradient(jnp.asarray(leaf)), initial)
    dtype = jnp.result_type(*[leaf for leaf in jax.tree.leaves(initial) if eqx.is_inexact_array(leaf)])
    initial, _ = jax.lax.scan(stage, initial, jnp.asarray(factors, dtype))
    return solve(problem, initial, solver=solver, max_steps=max_steps)
