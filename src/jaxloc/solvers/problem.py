"""Least-squares problems: a whitened residual with its data, normal equations and robust covariance."""

import math
from abc import abstractmethod
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxloc._linalg import matmul
from jaxloc.poses import retract, tangent_dimension
from jaxloc.solvers.cholesky import factor
from jaxloc.solvers.robust_kernels import Loss, Quadratic


class Linearization(NamedTuple):
    """A residual and its Jacobian by the tangent of the state.

    Attributes:
        residual: whitened, a pytree of arrays whose last axis runs over items (points, lines, ...).
        jacobian: the same pytree, each array with a leading axis over the tangent's d directions.
    """

    residual: Any
    jacobian: Any


class Problem(eqx.Module):
    """A least-squares problem: a whitened residual with its data, a pytree, so that new values never recompile.

    A residual is an array, or a pytree of arrays, over its standard deviation. The last axis runs over items, the axes
    before it over the components of one item; the loss acts on the squared norm of an item. ``loss`` is one kernel, or
    a pytree of kernels that is a prefix of the residual's.

    Subclasses give ``residual`` and ``loss``, and may give ``linearize`` where the Jacobian is short in closed form.
    """

    loss: eqx.AbstractVar[Any]

    @abstractmethod
    def residual(self, state: Any) -> Any:
        """Whitened residual at a state (any pytree with poses and arrays)."""

    def linearize(self, state: Any) -> Linearization:
        """Residual and Jacobian in the tangent space of the state; by forward differentiation unless overridden."""
        zero = jnp.zeros(tangent_dimension(state), float_dtype(state))
        residual, push = jax.linearize(lambda delta: self.residual(retract(state, delta)), zero)
        return Linearization(residual, jax.vmap(push)(jnp.eye(zero.size, dtype=zero.dtype)))

    def admissible(self, state: Any) -> Bool[Array, ""]:
        """Whether a minimum is consistent with the model; True unless overridden."""
        del state
        return jnp.array(True)

    def hessian(self, state: Any) -> Float[Array, "d d"]:
        """Exact Hessian of the cost along the tangent at a minimum, kernels included, for implicit derivatives.

        By forward-over-reverse differentiation, one direction at a time, unless overridden.
        """
        zero = jnp.zeros(tangent_dimension(state), float_dtype(state))
        slope = jax.grad(lambda delta: cost_along(self, state, delta))
        return jax.lax.map(lambda e: jax.jvp(slope, (zero,), (e,))[1], jnp.eye(zero.size, dtype=zero.dtype))


class FunctionProblem(Problem):
    """A problem of a plain function ``residual(state, data)``.

    The function is static: define it once at module level (a new lambda for every call would be compiled every time),
    and pass everything that changes in ``data``.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> def line(state, data):
        ...     return state["slope"] * data["x"] - data["y"]
        >>> data = {"x": jnp.array([1.0, 2.0]), "y": jnp.array([2.0, 4.0])}
        >>> float(jl.solvers.solve(jl.solvers.FunctionProblem(line, data), {"slope": jnp.array(0.0)}).value["slope"])
        2.0
    """

    function: Callable[[Any, Any], Any] = eqx.field(static=True)
    data: Any
    loss: Any = Quadratic()

    def residual(self, state: Any) -> Any:
        """The function at the state and the data."""
        return self.function(state, self.data)


class NormalEquations(NamedTuple):
    """Normal equations of a linearized problem.

    Attributes:
        cost: sum of rho.
        gradient: of the cost along the tangent.
        hessian: of the cost, in the Gauss-Newton form with IRLS weights: an upper bound, safe far from the minimum.
        correction: curvature correction of robust kernels (negative), bounded so that the Hessian stays positive; None
            for plain least squares. With it, steps near the minimum converge as fast as Newton's.
    """

    cost: Float[Array, ""]
    gradient: Float[Array, " d"]
    hessian: Float[Array, "d d"]
    correction: Float[Array, "d d"] | None


def float_dtype(state: Any) -> Any:
    """The floating dtype of a state."""
    return jnp.result_type(*[leaf for leaf in jax.tree.leaves(state) if eqx.is_inexact_array(leaf)])


def _is_loss(node: Any) -> bool:
    return isinstance(node, Loss)


def with_losses(loss: Any, *trees: Any) -> list[tuple]:
    """Pairs of a kernel and each array of the residual (and of trees with the same structure)."""
    pairs: list[tuple] = []

    def collect(kernel: Loss, *parts: Any) -> None:
        columns = [jax.tree.leaves(part) for part in parts]
        pairs.extend((kernel, *row) for row in zip(*columns, strict=True))

    jax.tree.map(collect, loss, *trees, is_leaf=_is_loss)
    return pairs


def items(residual: Array) -> Float[Array, "k n"]:
    """A residual array as components by items."""
    # Sizes are given, since none can be inferred when there are no items.
    return residual.reshape(math.prod(residual.shape[:-1]), residual.shape[-1] if residual.ndim else 1)


def cost(problem: Problem, state: Any) -> Float[Array, ""]:
    """The exact objective: the sum of rho over items."""
    parts = [
        jnp.sum(kernel.rho(jnp.sum(items(r) ** 2, axis=0)))
        for kernel, r in with_losses(problem.loss, problem.residual(state))
    ]
    return _total(parts)


def cost_along(problem: Problem, state: Any, delta: Float[Array, " d"]) -> Float[Array, ""]:
    """The exact objective along the tangent at a state."""
    return cost(problem, retract(state, delta))


def normal_equations(problem: Problem, state: Any) -> NormalEquations:
    """Cost, gradient and IRLS Gauss-Newton Hessian: one matrix product of the stacked Jacobian and residual."""
    linear = problem.linearize(state)
    parts = [
        _normal_part(kernel, items(r), j.reshape(j.shape[0], *items(r).shape))
        for kernel, r, j in with_losses(problem.loss, linear.residual, linear.jacobian)
    ]
    if not parts:
        raise ValueError("The residual holds no array: there is nothing to solve.")
    costs, gradients, hessians, corrections = zip(*parts, strict=True)
    present = [part for part in corrections if part is not None]
    return NormalEquations(_total(costs), _total(gradients), _total(hessians), _total(present) if present else None)


def _total(parts: Any) -> Array:
    return sum(parts[1:], start=parts[0])


def _normal_part(kernel: Loss, r: Float[Array, "k n"], j: Float[Array, "d k n"]) -> NormalEquations:
    stacked = jnp.concatenate([j, r[None]])
    size = stacked.shape[0]
    if isinstance(kernel, Quadratic):
        flat = stacked.reshape(size, r.size)
        product = matmul(flat, flat.T)
        return NormalEquations(0.5 * product[-1, -1], product[:-1, -1], product[:-1, :-1], None)
    squared = jnp.sum(r**2, axis=0)
    weight, slope = _weight_and_slope(kernel, squared)
    product = matmul((stacked * weight[None, None, :]).reshape(size, r.size), stacked.reshape(size, r.size).T)
    score = jnp.sum(j * r[None], axis=1)
    # At least a tenth of the weight remains along the residual.
    least = -0.9 * weight / jnp.where(squared > 0, squared, 1.0)
    fall = jnp.where(squared > 0, jnp.maximum(2.0 * slope, least), 0.0)
    correction = matmul(score * fall[None, :], score.T)
    return NormalEquations(jnp.sum(kernel.rho(squared)), product[:-1, -1], product[:-1, :-1], correction)


def _weight_and_slope(kernel: Loss, squared: Float[Array, " n"]) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """IRLS weight and its derivative in the squared norm."""
    return jax.jvp(kernel.weight, (squared,), (jnp.ones_like(squared),))


class _Scores(NamedTuple):
    """Contribution of one block of residuals to the sandwich estimator.

    Attributes:
        bread: curvature of its cost.
        score: derivative of each item's cost along the tangent; None for plain least squares.
        leverage: function of the inverse bread: the leverage of each item.
    """

    bread: Float[Array, "d d"]
    score: Float[Array, "d n"] | None
    leverage: Callable[[Array], Array] | None


def sandwich(problem: Problem, state: Any) -> tuple[Float[Array, "d d"], Float[Array, "d d"]]:
    """Bread and meat of the sandwich covariance ``A^-1 B A^-1`` of an M-estimate.

    Items under a quadratic loss obey the noise model: their ``B`` equals their ``A = J^T J``. Items under a robust
    kernel need not, so ``A`` is the curvature of rho and ``B`` the empirical covariance of the scores, each over one
    minus its item's leverage, since the fit reduces every residual (HC3 of MacKinnon and White).

    References:
        Huber, "The behavior of maximum likelihood estimates under nonstandard conditions", 1967.
        MacKinnon and White, "Some heteroskedasticity-consistent covariance matrix estimators", 1985.
    """
    linear = problem.linearize(state)
    blocks = [
        _scores(kernel, items(r), j.reshape(j.shape[0], *items(r).shape))
        for kernel, r, j in with_losses(problem.loss, linear.residual, linear.jacobian)
    ]
    bread = _total([block.bread for block in blocks])
    inverse = factor(bread).inverse()
    meat = []
    for block in blocks:
        if block.score is None or block.leverage is None:
            meat.append(block.bread)
            continue
        kept = 1.0 - jnp.clip(block.leverage(inverse), 0.0, 0.9)
        scaled = block.score / kept[None, :]
        meat.append(matmul(scaled, scaled.T))
    return bread, _total(meat)


def _scores(kernel: Loss, r: Float[Array, "k n"], j: Float[Array, "d k n"]) -> _Scores:
    flat = j.reshape(j.shape[0], r.size)
    if isinstance(kernel, Quadratic):
        return _Scores(matmul(flat, flat.T), None, None)
    weight, slope = _weight_and_slope(kernel, jnp.sum(r**2, axis=0))
    score = jnp.sum(j * r[None], axis=1)
    weighted = (j * weight[None, None, :]).reshape(j.shape[0], r.size)
    bread = matmul(weighted, flat.T) + 2.0 * matmul(score * slope[None, :], score.T)

    def leverage(inverse: Array) -> Array:
        share = jnp.sum(matmul(inverse, weighted) * flat, axis=0)
        return jnp.mean(share.reshape(r.shape), axis=0)

    return _Scores(bread, score * weight[None, :], leverage)


def is_quadratic(loss: Any) -> bool:
    """Whether every kernel is plain least squares."""
    return all(isinstance(kernel, Quadratic) for kernel in jax.tree.leaves(loss, is_leaf=_is_loss))
