"""What every one-shot method returns: a value, how sure it is, and whether to believe it."""

from enum import IntEnum
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxloc.beliefs import Gaussian
from jaxloc.poses import tangent_labels
from jaxloc.solvers.cholesky import rank_tolerance


class Status(IntEnum):
    """How a solve ended."""

    CONVERGED = 0
    MAX_STEPS = 1
    RANK_DEFICIENT = 2
    DIVERGED = 3
    NONFINITE = 4
    INADMISSIBLE = 5


_MEANING = {
    Status.CONVERGED: "converged",
    Status.MAX_STEPS: "not converged within max_steps: raise max_steps, start closer, or use LevenbergMarquardt()",
    Status.RANK_DEFICIENT: "the data do not determine every direction of the state",
    Status.DIVERGED: "the cost ended above that of the start: start closer, or use LevenbergMarquardt()",
    Status.NONFINITE: "the data or the start hold nan or inf",
    Status.INADMISSIBLE: "the answer contradicts the model, as a point behind the camera that sees it does",
}


class Observability(eqx.Module):
    """Which directions of the state the data determine.

    Attributes:
        eigenvalues: of the information matrix scaled to a unit diagonal, ascending; zero where nothing is known.
        directions: unit eigenvectors as columns, in the tangent space of the value.
        rank: number of directions that the data determine.
        condition: ratio of the largest to the smallest eigenvalue, inf when rank deficient.
    """

    eigenvalues: Float[Array, " d"]
    directions: Float[Array, "d d"]
    rank: Int[Array, ""]
    condition: Float[Array, ""]


class Estimate(eqx.Module):
    """The answer of an estimator.

    Attributes:
        value: the estimate: a pose, or any pytree with poses and arrays.
        covariance: in the tangent space of the value (right perturbation, translation before rotation).
        cost: the objective at the value, the sum of rho over whitened residuals.
        ok: whether value and covariance can be used. Gradients are zero where it is False.
        num_steps: solver steps taken (0 for closed forms).
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
        """The estimate as a density: what filters, trackers and pose graphs accept."""
        return Gaussian(self.value, self.covariance)

    @eqx.filter_jit
    def observability(self) -> Observability:
        """Spectrum and rank of the information matrix [K-13]."""
        diagonal = jnp.diagonal(self.information)
        known = diagonal > jnp.finfo(diagonal.dtype).tiny
        scale = jnp.where(known, 1.0 / jnp.sqrt(jnp.where(known, diagonal, 1.0)), 1.0)
        scaled = self.information * scale[:, None] * scale[None, :]
        eigenvalues, vectors = jnp.linalg.eigh(jnp.where(jnp.isfinite(scaled), scaled, 0.0))
        directions = vectors * scale[:, None]
        directions = directions / jnp.linalg.norm(directions, axis=0, keepdims=True)
        determined = eigenvalues > rank_tolerance(eigenvalues.dtype)
        smallest = jnp.where(determined[0], eigenvalues[0], 1.0)
        condition = jnp.where(determined[0], eigenvalues[-1] / smallest, jnp.inf)
        return Observability(eigenvalues, directions, jnp.sum(determined), condition)

    def describe(self) -> str:
        """One line for people: how it ended and, if so, which directions are unobservable (host only, one estimate)."""
        status = Status(int(self.status))
        text = f"{_MEANING[status]} ({int(self.num_steps)} steps, cost {float(self.cost):.6g})"
        if status is Status.RANK_DEFICIENT:
            seen = self.observability()
            names = tangent_labels(self.value)
            missing = [_spell(seen.directions[:, i], names) for i in range(len(names) - int(seen.rank))]
            text += f"; unobservable: {'; '.join(missing)}"
        return text

    def check(self) -> "Estimate":
        """Itself, when it is ok (host only).

        Raises:
            ValueError: it is not; the message says why.
        """
        if not bool(jnp.all(self.ok)):
            raise ValueError(f"The estimate is not usable: {self.describe()}.")
        return self


def _spell(direction: Float[Array, " d"], names: tuple[str, ...]) -> str:
    """A direction in words: its largest components by name."""
    largest = float(jnp.max(jnp.abs(direction)))
    terms = [(float(c), name) for c, name in zip(direction, names, strict=True) if abs(float(c)) > 0.1 * largest]
    terms.sort(key=lambda term: -abs(term[0]))
    return " ".join(f"{c:+.2f} {name}" for c, name in terms)
