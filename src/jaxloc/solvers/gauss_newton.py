"""Least-squares solvers on the tangent space, as optimistix solvers.

Optimistix adds Euclidean steps, so a pose given to its own solvers is silently fitted as a similarity. The solver here
keeps the pose as the state, moves it by retraction in every step, and hands tangent vectors to optimistix's descents
and searches, which stay as they are.

Normal equations are scaled to a unit diagonal, so that damping and trust regions know no units.
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
    """How to minimize: a strategy record."""

    rtol: eqx.AbstractVar[float | None]
    linear_solver: eqx.AbstractVar[lx.AbstractLinearSolver]

    @abstractmethod
    def descent(self) -> optx.AbstractDescent:
        """Which way to step."""

    @abstractmethod
    def search(self) -> optx.AbstractSearch:
        """How far to step."""

    @property
    @abstractmethod
    def damping(self) -> float:
        """Damping of the first step, relative to the unit diagonal; 1 where the descent has none."""


class GaussNewton(Solver):
    """Full steps to the bottom of the quadratic picture [K-71, K-73].

    Attributes:
        rtol: relative tolerance; None takes one that suits the dtype.
        linear_solver: `Cholesky` on the normal equations, or ``lineax.QR()`` on the Jacobian.
    """

    rtol: float | None = eqx.field(default=None, static=True)
    linear_solver: lx.AbstractLinearSolver = Cholesky()

    def descent(self) -> optx.AbstractDescent:
        """Newton's."""
        return optx.NewtonDescent(linear_solver=self.linear_solver)

    def search(self) -> optx.AbstractSearch:
        """None: the full step."""
        return optx.LearningRate(1.0)

    @property
    def damping(self) -> float:
        """None."""
        return 1.0


class LevenbergMarquardt(Solver):
    """Damped steps, never uphill: for starts far from the answer.

    Attributes:
        rtol: relative tolerance; None takes one that suits the dtype.
        linear_solver: `Cholesky` on the normal equations, or ``lineax.QR()`` on the Jacobian.
        initial_damping: relative to the diagonal of the normal equations (Marquardt's scaling).
    """

    rtol: float | None = eqx.field(default=None, static=True)
    linear_solver: lx.AbstractLinearSolver = Cholesky()
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
    """Powell's path from steepest descent to Gauss-Newton inside a trust region.

    Attributes:
        rtol: relative tolerance; None takes one that suits the dtype.
        linear_solver: `Cholesky` on the normal equations, or ``lineax.QR()`` on the Jacobian.
    """

    rtol: float | None = eqx.field(default=None, static=True)
    linear_solver: lx.AbstractLinearSolver = Cholesky()

    def descent(self) -> optx.AbstractDescent:
        """Dogleg."""
        return optx.DoglegDescent(linear_solver=self.linear_solver)

    def search(self) -> optx.AbstractSearch:
        """Trust region."""
        return optx.ClassicalTrustRegion(high_cutoff=0.75)

    @property
    def damping(self) -> float:
        """None."""
        return 1.0


class _Picture(NamedTuple):
    """Normal equations in tangent coordinates of unit curvature: ``delta = scale * x``."""

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
    picture: _Picture
    descent: Any
    search: Any
    terminate: Bool[Array, ""]
    status: Int[Array, ""]
    first_cost: Float[Array, ""]


class TangentSolver(optx.AbstractLeastSquaresSolver):
    """The optimistix solver behind every strategy: its ``args`` are the problem and the state's unmoving leaves."""

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

    def _picture(self, problem: Problem, y: Any, near: Bool[Array, ""]) -> _Picture:
        normal = normal_equations(problem, y)
        hessian = normal.hessian
        if normal.bend is not None:
            hessian = hessian + jnp.where(near, normal.bend, 0.0)
        diagonal = jnp.diagonal(hessian)
        positive = (diagonal > jnp.finfo(diagonal.dtype).tiny) & jnp.isfinite(diagonal)
        scale = jnp.where(positive, 1.0 / jnp.sqrt(jnp.where(positive, diagonal, 1.0)), 1.0)
        hessian = hessian * scale[:, None] * scale[None, :]
        residual, jacobian = _weighted_rows(problem, y, scale) if self._by_jacobian else (None, None)
        return _Picture(normal.cost, normal.gradient * scale, hessian, scale, residual, jacobian)

    def _normal_info(self, picture: _Picture) -> optx.FunctionInfo.EvalGradHessian:
        """What optimistix sees; over the initial damping, so that its unit damping is that part of the diagonal."""
        inverse = 1.0 / self.strategy.damping
        hessian = lx.MatrixLinearOperator(picture.hessian * inverse, lx.positive_semidefinite_tag)
        return optx.FunctionInfo.EvalGradHessian(picture.cost * inverse, picture.gradient * inverse, hessian)

    def _descent_info(self, picture: _Picture) -> Any:
        if not self._by_jacobian:
            return self._normal_info(picture)
        inverse = self.strategy.damping**-0.5
        return optx.FunctionInfo.ResidualJac(
            picture.residual * inverse, lx.MatrixLinearOperator(picture.jacobian * inverse)
        )

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> _State:
        """The state before the first evaluation."""
        problem, rest = args
        structure = jax.eval_shape(lambda: self._picture(problem, eqx.combine(y, rest), jnp.array(False)))
        picture = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), structure)
        step = jnp.zeros_like(picture.gradient)
        descent = self.strategy.descent().init(step, self._descent_info(picture))
        descent = eqx.filter(descent, eqx.is_array, inverse=False)
        search = self.strategy.search().init(step, self._normal_info(picture))
        search = jax.tree.map(lambda leaf: leaf.astype(step.dtype), search)
        descent = jax.tree.map(lambda leaf: _as(leaf, step.dtype), descent)
        converged = jnp.asarray(int(Status.CONVERGED))
        return _State(
            jnp.array(True), jnp.array(False), step, picture, descent, search, jnp.array(False), converged, picture.cost
        )

    def step(self, fn, y, args, options, state: _State, tags):
        """Evaluates where the last step led, accepts or rejects it, and chooses the next one."""
        problem, rest = args
        moved = retract(y, state.picture.scale * state.step)
        found = self._picture(problem, eqx.combine(moved, rest), state.near)
        zero = jnp.zeros_like(state.step)
        size, accept, _, search = self.strategy.search().step(
            state.first, zero, state.step, self._normal_info(state.picture), self._normal_info(found), state.search
        )
        size = size.astype(zero.dtype)
        finite = jnp.isfinite(found.cost) & jnp.all(jnp.isfinite(found.gradient))
        accept = accept & finite
        y, picture = _where(accept, (moved, found), (y, state.picture))
        descent = self.strategy.descent()
        # The queries of optimistix's descents depend on the accepted picture alone, so asking again costs nothing new.
        descent_state = descent.query(zero, self._descent_info(picture), state.descent)
        step, _ = descent.step(size, descent_state)
        step = jnp.where(jnp.isfinite(step), step, 0.0)
        small = self._small(y, picture, step)
        lost = ~finite & (state.first | isinstance(self.strategy, GaussNewton))
        status = jnp.where(lost, int(Status.NONFINITE), int(Status.CONVERGED))
        search = jax.tree.map(lambda leaf: leaf.astype(zero.dtype), search)
        descent_state = jax.tree.map(lambda leaf: _as(leaf, zero.dtype), eqx.filter(descent_state, eqx.is_array))
        first_cost = jnp.where(state.first, found.cost, state.first_cost)
        state = _State(
            first=jnp.array(False),
            # Within a sigma of the minimum the kernels' curvature can be trusted.
            near=-jnp.sum(picture.gradient * step) < 1.0,
            step=step,
            picture=picture,
            descent=descent_state,
            search=search,
            terminate=small | lost,
            status=status.astype(int),
            first_cost=first_cost,
        )
        return y, state, None

    def _small(self, y: Any, picture: _Picture, step: Float[Array, " d"]) -> Bool[Array, ""]:
        """Whether a step is too small to matter: against the cost, or against the value."""
        decrease = -0.5 * jnp.sum(picture.gradient * step)
        size = jnp.max(jnp.abs(picture.scale * step))
        largest = jnp.max(jnp.stack([jnp.max(jnp.abs(leaf)) for leaf in jax.tree.leaves(y)]))
        return (decrease <= self.rtol * picture.cost) | (size <= self.atol * (1.0 + largest))

    def terminate(self, fn, y, args, options, state: _State, tags):
        """Whether the next step would be too small to matter."""
        return state.terminate, optx.RESULTS.successful

    def postprocess(self, fn, y, aux, args, options, state: _State, tags, result):
        """Takes the last step, too small to need another evaluation, and says how it ended."""
        done = state.terminate & (state.status == int(Status.CONVERGED))
        last = retract(y, jnp.where(done, state.picture.scale * state.step, 0.0))
        status = jnp.where(state.terminate, state.status, int(Status.MAX_STEPS))
        status = jnp.where(state.picture.cost > state.first_cost * 1.001, int(Status.DIVERGED), status)
        deficient = factor(state.picture.hessian).deficient & (status <= int(Status.MAX_STEPS))
        status = jnp.where(deficient, int(Status.RANK_DEFICIENT), status)
        problem, rest = args
        senseless = done & ~problem.admissible(eqx.combine(last, rest)) & ~deficient
        status = jnp.where(senseless, int(Status.INADMISSIBLE), status)
        finite = jnp.isfinite(state.picture.cost) & jnp.all(jnp.isfinite(state.picture.hessian))
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
        jacobians.append((j * root[None, None, :]).reshape(j.shape[0], -1).T * scale[None, :])
    return jnp.concatenate(residuals), jnp.concatenate(jacobians)


def _where(accept: Bool[Array, ""], new: Any, old: Any) -> Any:
    return tree.where(accept, new, old)


def _as(leaf: Any, dtype: Any) -> Any:
    """Optimistix starts some scalars in the default dtype; the problem's rules here."""
    return leaf.astype(dtype) if eqx.is_inexact_array(leaf) else leaf
