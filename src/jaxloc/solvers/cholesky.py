"""Cholesky factorization of positive semidefinite matrices with rank detection, also as a lineax solver.

A pivot at rounding level marks a direction that the data do not determine. Solves drop the component along it, so that
steps do not move there; inverses use the tolerance in its place, so that the variance there is huge but finite.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, Bool, Float

from jaxloc._linalg import UNROLLED, back_substitution, cholesky, forward_substitution, matmul


def rank_tolerance(dtype: Any) -> float:
    """Pivot of a unit-diagonal matrix below which a direction counts as undetermined."""
    return 50.0 * float(jnp.finfo(dtype).eps)


class Factor(eqx.Module):
    """Lower triangular factor of a scaled matrix, ``D H D = L L^T``, with the pivots that are at rounding level marked.

    Attributes:
        lower: rows of L, zero above the diagonal.
        lost: directions whose pivot is at rounding level.
        scale: the diagonal of D, which makes the diagonal of the scaled matrix one.
    """

    lower: Float[Array, "d d"]
    lost: Bool[Array, " d"]
    scale: Float[Array, " d"]

    @property
    def deficient(self) -> Bool[Array, ""]:
        """Whether any direction is undetermined."""
        return jnp.any(self.lost)

    def solve(self, vector: Float[Array, " d"]) -> Float[Array, " d"]:
        """Solution of ``H x = vector`` with no component along undetermined pivots."""
        diagonal = jnp.where(self.lost, 1.0, jnp.diagonal(self.lower))
        kept = jnp.where(self.lost, 0.0, 1.0 / diagonal)
        return self.scale * back_substitution(
            self.lower, forward_substitution(self.lower, self.scale * vector, kept), kept
        )

    def inverse(self) -> Float[Array, "d d"]:
        """Inverse of H; along undetermined pivots the variance is finite, but huge."""
        size = self.scale.shape[0]
        if size <= UNROLLED:
            inverse = _unrolled_gram(_unrolled_inverse(self.lower))
        else:
            inverse_lower = forward_substitution(self.lower, jnp.eye(size, dtype=self.scale.dtype))
            inverse = matmul(inverse_lower.T, inverse_lower)
        return inverse * self.scale[:, None] * self.scale[None, :]


def factor(matrix: Float[Array, "d d"]) -> Factor:
    """Cholesky factorization of a positive semidefinite matrix, scaled to a unit diagonal, with rank detection.

    Args:
        matrix: symmetric, its lower triangle is read.

    Returns:
        The factor; undetermined directions are marked in `lost`.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> factor = jl.solvers.cholesky.factor(jnp.array([[4.0, 2.0], [2.0, 3.0]]))
        >>> factor.solve(jnp.array([8.0, 7.0])).round(4).tolist()
        [1.25, 1.5]
    """
    # NaN left in the matrix would pass to the derivatives of every entry scaled with it.
    matrix = jnp.where(jnp.isfinite(matrix), matrix, 0.0)
    diagonal = jnp.diagonal(matrix)
    positive = diagonal > jnp.finfo(matrix.dtype).tiny
    scale = jnp.where(positive, 1.0 / jnp.sqrt(jnp.where(positive, diagonal, 1.0)), 1.0)
    scaled = matrix * scale[:, None] * scale[None, :]
    scaled = jnp.where(jnp.isfinite(scaled), scaled, 0.0)
    lower, lost = cholesky(scaled, rank_tolerance(matrix.dtype))
    return Factor(lower, lost, scale)


def _unrolled_inverse(lower: Float[Array, "d d"]) -> list[list[Array]]:
    """Rows of the inverse of a lower triangular matrix, up to the diagonal."""
    rows: list[list[Array]] = []
    for i in range(lower.shape[0]):
        pivot = 1.0 / lower[i, i]
        row = []
        for j in range(i):
            value = lower[i, j] * rows[j][j]
            for k in range(j + 1, i):
                value = value + lower[i, k] * rows[k][j]
            row.append(-value * pivot)
        rows.append([*row, pivot])
    return rows


def _unrolled_gram(rows: list[list[Array]]) -> Float[Array, "d d"]:
    """``M^T M`` of a lower triangular matrix."""
    size = len(rows)
    entry = {}
    for i in range(size):
        for j in range(i + 1):
            terms = [rows[k][i] * rows[k][j] for k in range(i, size)]
            entry[i, j] = entry[j, i] = sum(terms[1:], start=terms[0])
    return jnp.stack([jnp.stack([entry[i, j] for j in range(size)]) for i in range(size)])


class Cholesky(lx.AbstractLinearSolver):
    """The factorization as a lineax solver for (damped) normal equations.

    It squares the condition number of the Jacobian that QR works on, and is several times faster in batches. Use
    `QR` where the Jacobian's condition exceeds the square root of the precision: about 1e3 in float32, 1e7
    in float64.
    """

    def init(self, operator: lx.AbstractLinearOperator, options: dict[str, Any]) -> Factor:
        """Factors the operator's matrix."""
        del options
        return factor(operator.as_matrix())

    def compute(self, state: Factor, vector: Any, options: dict[str, Any]) -> tuple[Any, lx.RESULTS, dict[str, Any]]:
        """Solves; an undetermined system is no error, its solution has no component along undetermined directions."""
        del options
        return state.solve(vector), lx.RESULTS.successful, {}

    def transpose(self, state: Factor, options: dict[str, Any]) -> tuple[Factor, dict[str, Any]]:
        """The matrix is symmetric."""
        return state, options

    def conj(self, state: Factor, options: dict[str, Any]) -> tuple[Factor, dict[str, Any]]:
        """The matrix is real."""
        return state, options

    def assume_full_rank(self) -> bool:
        """Derivatives of the solve are those of the inverse."""
        return True
