"""Estimate: the result of one-shot estimators, a value with covariance, status and observability."""

from collections.abc import Callable
from enum import IntEnum
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxloc import _linalg
from jaxloc import _tree as tree
from jaxloc._jit import filter_jit
from jaxloc.beliefs import Gaussian, validity
from jaxloc.poses import tangent_labels
from jaxloc.solvers.cholesky import rank_tolerance


class Status(IntEnum):
    """Status of an estimate."""

    CONVERGED = 0
    MAX_STEPS = 1
    RANK_DEFICIENT = 2
    DIVERGED = 3
    NONFINITE = 4
    INADMISSIBLE = 5
    IMPRECISE = 6


_MEANING = {
    Status.CONVERGED: "converged",
    Status.MAX_STEPS: "not converged within max_steps: raise max_steps, start closer, or use LevenbergMarquardt()",
    Status.RANK_DEFICIENT: "the data do not determine every direction of the state",
    Status.DIVERGED: "the cost ended above the initial one: start closer, or use LevenbergMarquardt()",
    Status.NONFINITE: "the data or the initial value hold nan or inf",
    Status.INADMISSIBLE: "the result contradicts the model, such as an observed point behind its camera",
    Status.IMPRECISE: "rounding exceeds the stated noise: take a common offset off the coordinates, or use float64",
}


class Observability(eqx.Module):
    """Spectrum of the information matrix: which directions of the state the data determine.

    Attributes:
        eigenvalues: of the information matrix scaled to a unit diagonal, ascending; zero along undetermined directions.
        directions: unit eigenvectors as columns, in the tangent space of the value.
        rank: number of directions that the data determine.
        condition: ratio of the largest to the smallest eigenvalue, inf when rank deficient.
    """

    eigenvalues: Float[Array, " d"]
    directions: Float[Array, "d d"]
    rank: Int[Array, ""]
    condition: Float[Array, ""]


class Estimate(eqx.Module):
    """Result of an estimator.

    Attributes:
        value: the estimate: a pose, or any pytree with poses and arrays.
        covariance: in the tangent space of the value (right perturbation, translation before rotation).
        cost: the objective at the value, the sum of rho over whitened residuals.
        ok: whether value and covariance can be used. Gradients are zero where it is False.
        num_steps: number of solver steps (0 for closed forms).
        status: a `Status` code.
        information: the Gauss-Newton Hessian at the value.
    """

    value: Any
    covariance: Float[Array, "d d"]
    cost: Float[Array, ""]
    ok: Bool[Array, ""]
    num_steps: Int[Array, ""]
    status: Int[Array, ""]
    information: Float[Array, "d d"]

    def gaussian(self) -> Gaussian:
        """The estimate as a density, as filters, trackers and pose graphs take it."""
        return Gaussian(self.value, self.covariance)

    @filter_jit
    def observability(self) -> Observability:
        """Spectrum and rank of the information matrix [K-13]."""
        diagonal = jnp.diagonal(self.information)
        known = diagonal > jnp.finfo(diagonal.dtype).tiny
        scale = jnp.where(known, 1.0 / jnp.sqrt(jnp.where(known, diagonal, 1.0)), 1.0)
        scaled = self.information * scale[:, None] * scale[None, :]
        eigenvalues, vectors = _linalg.eigh(jnp.where(jnp.isfinite(scaled), scaled, 0.0))
        directions = vectors * scale[:, None]
        directions = directions / jnp.linalg.norm(directions, axis=0, keepdims=True)
        determined = eigenvalues > rank_tolerance(eigenvalues.dtype)
        smallest = jnp.where(determined[0], eigenvalues[0], 1.0)
        condition = jnp.where(determined[0], eigenvalues[-1] / smallest, jnp.inf)
        return Observability(eigenvalues, directions, jnp.sum(determined), condition)

    def describe(self) -> str:
        """One line of text: the status and any unobservable directions (host only, one estimate)."""
        status = Status(int(self.status))
        text = f"{_MEANING[status]} ({int(self.num_steps)} steps, cost {float(self.cost):.6g})"
        if status is Status.RANK_DEFICIENT:
            spectrum = self.observability()
            names = tangent_labels(self.value)
            count = len(names) - int(spectrum.rank)
            missing = [_describe_direction(spectrum.directions[:, i], names) for i in range(count)]
            text += f"; unobservable: {'; '.join(missing)}"
        return text

    def check(self) -> "Estimate":
        """The estimate itself, if ok (host only).

        Raises:
            ValueError: if not; the message gives the status.
        """
        if not bool(jnp.all(self.ok)):
            raise ValueError(f"The estimate is not usable: {self.describe()}.")
        return self


def guarded(usable: Bool[Array, ""], estimate: Callable[..., Any], *args: Any) -> Any:
    """``estimate(*args)``; where it is not usable, ``ok`` is False, numbers are finite, and derivatives are zero.

    The guard of one-shot estimators against numbers that only the result shows to be too large, as `_tree.protect`
    is that of filters. What an estimator itself says is kept.

    Args:
        usable: whether the inputs can be used, such as a standard deviation (see `positive`).
        estimate: returns a record with a flag ``ok``, and a `Status` where it has one, or holds one as ``estimate``.
        args: of it. Masks and integers are given here, not closed over.

    Returns:
        The record.

    Example:
        >>> def far(x):
        ...     return jl.solvers.align_points(x * jnp.eye(3), jnp.eye(3))
        >>> import jaxloc as jl
        >>> bool(guarded(jnp.array(True), far, jnp.array(1.0)).ok), bool(guarded(jnp.array(False), far, 1.0).ok)
        (True, False)
    """

    def run(usable: Bool[Array, ""], *args: Any) -> tuple[Bool[Array, ""], Any]:
        whole = estimate(*args)
        found = getattr(whole, "estimate", whole)
        finite = tree.all_finite(found)
        ok = found.ok & usable & finite
        if hasattr(found, "status"):
            status = jnp.where(found.ok & ~usable, int(Status.INADMISSIBLE), found.status)
            status = jnp.where(finite, status, int(Status.NONFINITE)).astype(found.status.dtype)
            found = eqx.tree_at(lambda record: record.status, found, status)
        found = eqx.tree_at(lambda record: record.ok, found, ok)
        return ok, found if found is whole or not hasattr(whole, "estimate") else eqx.tree_at(_inner, whole, found)

    ok, whole = tree.protect(run, usable, *args)
    # Also where it is ok: derivatives of what is finite alone pass.
    return tree.where(ok, whole, validity.finite_or_neutral(whole))


def _inner(record: Any) -> Any:
    return record.estimate


def _describe_direction(direction: Float[Array, " d"], names: tuple[str, ...]) -> str:
    """A direction as text: its largest components by name."""
    largest = float(jnp.max(jnp.abs(direction)))
    terms = [(float(c), name) for c, name in zip(direction, names, strict=True) if abs(float(c)) > 0.1 * largest]
    terms.sort(key=lambda term: -abs(term[0]))
    return " ".join(f"{c:+.2f} {name}" for c, name in terms)
