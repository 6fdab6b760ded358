"""Graduated non-convexity: robust problems from a bad start, by kernels that begin wide."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxloc.solvers.estimate import Estimate
from jaxloc.solvers.gauss_newton import GaussNewton, Solver
from jaxloc.solvers.least_squares import minimize, solve
from jaxloc.solvers.problem import Problem
from jaxloc.solvers.robust_kernels import Loss


@eqx.filter_jit
def solve_graduated(
    problem: Problem,
    initial: Any,
    *,
    factors: tuple[float, ...] = (16.0, 8.0, 4.0, 2.0),
    steps_each: int = 2,
    solver: Solver = GaussNewton(),
    max_steps: int = 50,
) -> Estimate:
    """Minimizes a robust problem through a series of wider kernels.

    A redescending kernel has a minimum for every group of outliers that agree. With its scale multiplied by a large
    factor the objective is nearly convex; a few steps at each smaller factor follow its minimum into the right one.

    Args:
        problem: a problem whose field ``loss`` holds its kernels.
        initial: where to start.
        factors: scale factors, from wide to narrow; 1 comes by itself.
        steps_each: solver steps at each factor.
        solver: how to minimize.
        max_steps: bound on the steps of the last stage.

    Returns:
        The estimate of the problem itself, as `solve` gives it; ``num_steps`` counts the last stage.

    References:
        Blake and Zisserman, "Visual Reconstruction", 1987; Yang et al., "Graduated non-convexity for robust spatial
        perception", RA-L 2020 [K-60].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> def spread(state, data):
        ...     return state - data
        >>> data = jnp.array([1.0, 1.1, 0.9, 1.05, 30.0, 40.0])
        >>> problem = jl.solvers.FunctionProblem(spread, data, jl.solvers.GemanMcClure(1.0))
        >>> round(float(jl.solvers.solve_graduated(problem, jnp.array(20.0)).value), 2)
        1.01
    """
    is_loss = lambda node: isinstance(node, Loss)  # noqa: E731

    def stage(value: Any, factor: Any) -> tuple[Any, None]:
        widened = jax.tree.map(lambda kernel: kernel.widened(factor), problem.loss, is_leaf=is_loss)
        wide = eqx.tree_at(lambda p: p.loss, problem, widened)
        return minimize(wide, value, solver, steps_each)[0], None

    start = jax.tree.map(lambda leaf: jax.lax.stop_gradient(jnp.asarray(leaf)), initial)
    dtype = jnp.result_type(*[leaf for leaf in jax.tree.leaves(start) if eqx.is_inexact_array(leaf)])
    start, _ = jax.lax.scan(stage, start, jnp.asarray(factors, dtype))
    return solve(problem, start, solver=solver, max_steps=max_steps)
