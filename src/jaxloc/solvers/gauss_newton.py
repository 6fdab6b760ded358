"""Gauss-Newton, Levenberg-Marquardt and dogleg on manifolds, as optimistix solvers.

Optimistix adds Euclidean steps, so a pose given to its own solvers is silently fitted as a similarity. The solver here
keeps the pose as the state, moves it by retraction in every step, and passes tangent vectors to optimistix's own
descents and searches.

Normal equations are scaled to a unit diagonal, so that damping and trust regions do not depend on units.
"""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from jaxloc import _tree as tree
from jaxloc.poses import retract
from jaxloc.solvers.cholesky import Cholesky, factor
from jaxloc.solvers.estimate import Status
from jaxloc.solvers.problem import Problem, items, normal_equations, with_losses


class Solver(eqx.Module):
    """A minimization strategy.

    Attributes:
        rtol: relative tolerance; None takes one that suits the dtype.
        linear_solver: `Cholesky` on the normal equations, or `QR` on the Jacobian.
    """

    rtol: float | None = eqx.field(default=None, static=True)
    linear_solver: lx.AbstractLinearSolver = Cholesky()

    @abstractmethod
    def descent(self) -> optx.AbstractDescent:
        """Direction of the steps."""

    @abstractmethod
    def search(self) -> optx.AbstractSearch:
        """Length of the steps."""

    @property
    def damping(self) -> float:
        """Damping of the first step, relative to the unit diagonal; 1 where the descent has none."""
        return 1.0


class GaussNewton(Solver):
    """Gauss-Newton: full steps to the minimum of the quadratic model [K-71, K-73]."""

    def descent(self) -> optx.AbstractDescent:
        """Newton's."""
        return optx.NewtonDescent(linear_solver=self.linear_solver)

    def search(self) -> optx.AbstractSearch:
        """The full step."""
        return optx.LearningRate(1.0)


class LevenbergMarquardt(Solver):
    """Levenberg-Marquardt: damped steps that never increase the cost, for initial values far from the minimum.

    Attributes:
        initial_damping: relative to the diagonal of the normal equations (Marquardt's scaling).
    """

    initial_damping: float = eqx.field(default=1e-3, static=True)

    def descent(self) -> optx.AbstractDescent:
        """Damped Newton's."""
        return optx.DampedNewtonDescent(linear_solver=self.linear_solver)

    def search(self) -> optx.AbstractSearch:
        """Trust region."""
        return optx.ClassicalTrustRegion(high_cutoff=0.75)

    @property
    def damping(self) -> float:
        """The initial damping."""
        return self.initial_damping


class Dogleg(Solver):
    """Powell's dogleg between steepest descent and Gauss-Newton inside a trust region."""

    def descent(self) -> optx.AbstractDescent:
        """Dogleg."""
        return optx.DoglegDescent(linear_solver=self.linear_solver)

    def search(self) -> optx.AbstractSearch:
        """Trust region."""
        return optx.ClassicalTrustRegion(high_cutoff=0.75)


class _QuadraticModel(NamedTuple):
    """Quadratic model of the objective in tangent coordinates of unit curvature, ``delta = scale * x``."""

    cost: Float[Array, ""]
    gradient: Float[Array, " d"]
    hessian: Float[Array, "d d"]
    scale: Float[Array, " d"]
    residual: Any
    jacobian: Any


class _State(NamedTuple):
    first: Bool[Array, ""]
    near: Bool[Array, ""]
    step: Float[Array, " d"]
    model: _QuadraticModel
    descent: Any
    search: Any
    terminate: Bool[Array, ""]
    status: Int[Array, ""]
    first_cost: Float[Array, ""]


class TangentSolver(optx.AbstractLeastSquaresSolver):
    """The optimistix solver of all strategies; its ``args`` are the problem and the state's leaves that do not move."""

    strategy: Solver
    rtol: float = eqx.field(static=True)
    atol: float = eqx.field(static=True)
    norm: Callable = eqx.field(static=True)

    def __init__(self, strategy: Solver, dtype: Any):
        eps = float(jnp.finfo(dtype).eps)
        self.strategy = strategy
        # Steps below this part of the value, or of the cost, are rounding noise.
        self.rtol = strategy.rtol if strategy.rtol is not None else 10.0 * eps
        self.atol = self.rtol
        self.norm = optx.max_norm

    @property
    def _by_jacobian(self) -> bool:
        return not isinstance(self.strategy.linear_solver, Cholesky)

    def _model(self, problem: Problem, y: Any, near: Bool[Array, ""]) -> _QuadraticModel:
        normal = normal_equations(problem, y)
        hessian = normal.hessian
        if normal.correction is not None:
            hessian = hessian + jnp.where(near, normal.correction, 0.0)
        diagonal = jnp.diagonal(hessian)
        positive = (diagonal > jnp.finfo(diagonal.dtype).tiny) & jnp.isfinite(diagonal)
        scale = jnp.where(positive, 1.0 / jnp.sqrt(jnp.where(positive, diagonal, 1.0)), 1.0)
        hessian = hessian * scale[:, None] * scale[None, :]
        residual, jacobian = _weighted_rows(problem, y, scale) if self._by_jacobian else (None, None)
        return _QuadraticModel(normal.cost, normal.gradient * scale, hessian, scale, residual, jacobian)

    def _normal_info(self, model: _QuadraticModel) -> optx.FunctionInfo.EvalGradHessian:
        """The model for optimistix, over the initial damping, so that its unit damping is that part of the diagonal."""
        inverse = 1.0 / self.strategy.damping
        hessian = lx.MatrixLinearOperator(model.hessian * inverse, lx.positive_semidefinite_tag)
        return optx.FunctionInfo.EvalGradHessian(model.cost * inverse, model.gradient * inverse, hessian)

    def _descent_info(self, model: _QuadraticModel) -> Any:
        if not self._by_jacobian:
            return self._normal_info(model)
        inverse = self.strategy.damping**-0.5
        return optx.FunctionInfo.ResidualJac(
            model.residual * inverse, lx.MatrixLinearOperator(model.jacobian * inverse)
        )

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> _State:
        """The state before the first evaluation."""
        problem, rest = args
        structure = jax.eval_shape(lambda: self._model(problem, eqx.combine(y, rest), jnp.array(False)))
        model = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), structure)
        step = jnp.zeros_like(model.gradient)
        descent = self.strategy.descent().init(step, self._descent_info(model))
        descent = eqx.filter(descent, eqx.is_array, inverse=False)
        search = self.strategy.search().init(step, self._normal_info(model))
        search = jax.tree.map(lambda leaf: leaf.astype(step.dtype), search)
        descent = jax.tree.map(lambda leaf: _as(leaf, step.dtype), descent)
        converged = jnp.asarray(int(Status.CONVERGED))
        return _State(
            jnp.array(True), jnp.array(False), step, model, descent, search, jnp.array(False), converged, model.cost
        )

    def step(self, fn, y, args, options, state: _State, tags):
        """Evaluates the result of the last step, accepts or rejects it, and computes the next one."""
        problem, rest = args
        moved = retract(y, state.model.scale * state.step)
        found = self._model(problem, eqx.combine(moved, rest), state.near)
        zero = jnp.zeros_like(state.step)
        size, accept, _, search = self.strategy.search().step(
            state.first, zero, state.step, self._normal_info(state.model), self._normal_info(found), state.search
        )
        size = size.astype(zero.dtype)
        finite = jnp.isfinite(found.cost) & jnp.all(jnp.isfinite(found.gradient))
        accept = accept & finite
        y, model = tree.where(accept, (moved, found), (y, state.model))
        descent = self.strategy.descent()
        # The queries of optimistix's descents depend on the accepted model alone, so repeating them changes nothing.
        descent_state = descent.query(zero, self._descent_info(model), state.descent)
        step, _ = descent.step(size, descent_state)
        step = jnp.where(jnp.isfinite(step), step, 0.0)
        small = self._small(y, model, step)
        lost = ~finite & (state.first | isinstance(self.strategy, GaussNewton))
        status = jnp.where(lost, int(Status.NONFINITE), int(Status.CONVERGED))
        search = jax.tree.map(lambda leaf: leaf.astype(zero.dtype), search)
        descent_state = jax.tree.map(lambda leaf: _as(leaf, zero.dtype), eqx.filter(descent_state, eqx.is_array))
        first_cost = jnp.where(state.first, found.cost, state.first_cost)
        state = _State(
            first=jnp.array(False),
            # Within a standard deviation of the minimum the exact curvature of the kernels is used.
            near=-jnp.sum(model.gradient * step) < 1.0,
            step=step,
            model=model,
            descent=descent_state,
            search=search,
            terminate=small | lost,
            status=status.astype(int),
            first_cost=first_cost,
        )
        return y, state, None

    def _small(self, y: Any, model: _QuadraticModel, step: Float[Array, " d"]) -> Bool[Array, ""]:
        """Whether a step is negligible, relative to the cost or to the value."""
        decrease = -0.5 * jnp.sum(model.gradient * step)
        size = jnp.max(jnp.abs(model.scale * step))
        largest = jnp.max(jnp.stack([jnp.max(jnp.abs(leaf)) for leaf in jax.tree.leaves(y)]))
        return (decrease <= self.rtol * model.cost) | (size <= self.atol * (1.0 + largest))

    def terminate(self, fn, y, args, options, state: _State, tags):
        """Whether the next step would be negligible."""
        return state.terminate, optx.RESULTS.successful

    def postprocess(self, fn, y, aux, args, options, state: _State, tags, result):
        """Takes the last step without another evaluation, and determines the status."""
        done = state.terminate & (state.status == int(Status.CONVERGED))
        last = retract(y, jnp.where(done, state.model.scale * state.step, 0.0))
        status = jnp.where(state.terminate, state.status, int(Status.MAX_STEPS))
        status = jnp.where(state.model.cost > state.first_cost * 1.001, int(Status.DIVERGED), status)
        deficient = factor(state.model.hessian).deficient & (status <= int(Status.MAX_STEPS))
        status = jnp.where(deficient, int(Status.RANK_DEFICIENT), status)
        problem, rest = args
        inadmissible = done & ~problem.admissible(eqx.combine(last, rest)) & ~deficient
        status = jnp.where(inadmissible, int(Status.INADMISSIBLE), status)
        finite = jnp.isfinite(state.model.cost) & jnp.all(jnp.isfinite(state.model.hessian))
        status = jnp.where(finite, status, int(Status.NONFINITE))
        return last, aux, {"status": status.astype(int)}


def _weighted_rows(problem: Problem, y: Any, scale: Float[Array, " d"]) -> tuple[Array, Array]:
    """Residual and Jacobian as rows, with the square roots of the IRLS weights, for QR."""
    linear = problem.linearize(y)
    residuals, jacobians = [], []
    for kernel, r, j in with_losses(problem.loss, linear.residual, linear.jacobian):
        r = items(r)
        j = j.reshape(j.shape[0], *r.shape)
        root = jnp.sqrt(kernel.weight(jnp.sum(r**2, axis=0)))
        residuals.append((r * root[None, :]).reshape(-1))
        jacobians.append((j * root[None, None, :]).reshape(j.shape[0], r.size).T * scale[None, :])
    return jnp.concatenate(residuals), jnp.concatenate(jacobians)


def _as(leaf: Any, dtype: Any) -> Any:
    """The leaf in the problem's dtype: optimistix creates some scalars in the default one."""
    return leaf.astype(dtype) if eqx.is_inexact_array(leaf) else leaf
