"""Cholesky factorization that never fails, and substitution."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxloc._linalg.lapack import first_cholesky, solve_lower

UNROLLED = 9  # up to this size unrolled columns are faster than the library's factorization under vmap


def cholesky(matrix: Float[Array, "d d"], floor: float) -> tuple[Float[Array, "d d"], Bool[Array, " d"]]:
    """Lower triangular factor of a positive semidefinite matrix of unit diagonal, and which pivots were too small.

    Up to nine rows the columns are unrolled: pivots at or below the floor (also NaN) are replaced by it, and the
    column below them is zero. Larger matrices are factored by the library; where that fails, the matrix with
    ``sqrt(eps)`` added to its diagonal is factored instead, and the identity where that fails too.

    Args:
        matrix: "d d"; the lower triangle is read.
        floor: smallest pivot (squared diagonal entry of the factor).

    Returns:
        The factor, and the marks of the pivots below the floor (all of them where the library failed).

    References:
        Golub and Van Loan, *Matrix Computations*, 2013, section 4.2.

    Example:
        >>> import jax.numpy as jnp
        >>> lower, small = cholesky(jnp.array([[1.0, 0.6], [0.6, 1.0]]), 1e-6)
        >>> lower.round(3).tolist(), small.tolist()
        ([[1.0, 0.0], [0.6000000238418579, 0.800000011920929]], [False, False])
    """
    return _unrolled(matrix, floor) if matrix.shape[0] <= UNROLLED else _by_library(matrix, floor)


def forward_substitution(
    lower: Float[Array, "d d"], right: Float[Array, "d *k"], reciprocal: Float[Array, " d"] | None = None
) -> Float[Array, "d *k"]:
    """``L^-1 b`` for a lower triangular L.

    Args:
        lower: L.
        right: b.
        reciprocal: one over the diagonal of L, if not plainly that: zeros drop the component of their pivot. (Only up
            to nine rows; larger systems are solved by the library.)

    Example:
        >>> import jax.numpy as jnp
        >>> forward_substitution(jnp.array([[2.0, 0.0], [1.0, 4.0]]), jnp.array([2.0, 5.0])).tolist()
        [1.0, 1.0]
    """
    if lower.shape[0] > UNROLLED:
        return solve_lower(lower, right)
    solution: list[Array] = []
    for i in range(lower.shape[0]):
        value = right[i]
        for k in range(i):
            value = value - lower[i, k] * solution[k]
        solution.append(value / lower[i, i] if reciprocal is None else value * reciprocal[i])
    return jnp.stack(solution)


def back_substitution(
    lower: Float[Array, "d d"], right: Float[Array, "d *k"], reciprocal: Float[Array, " d"] | None = None
) -> Float[Array, "d *k"]:
    """``L^-T b`` for a lower triangular L.

    Args:
        lower: L.
        right: b.
        reciprocal: as in `forward_substitution`.

    Example:
        >>> import jax.numpy as jnp
        >>> back_substitution(jnp.array([[2.0, 0.0], [1.0, 4.0]]), jnp.array([3.0, 4.0])).tolist()
        [1.0, 1.0]
    """
    # The transposed system is lower triangular again when its rows and columns are reversed.
    flipped = None if reciprocal is None else reciprocal[::-1]
    return forward_substitution(lower.T[::-1, ::-1], right[::-1], flipped)[::-1]


def _unrolled(matrix: Float[Array, "d d"], floor: float) -> tuple[Float[Array, "d d"], Bool[Array, " d"]]:
    size, dtype = matrix.shape[0], matrix.dtype
    columns, marks, rest = [], [], matrix
    for j in range(size):
        pivot = rest[0, 0]
        small = ~(pivot > floor)
        root = jnp.sqrt(jnp.where(small, floor, pivot))
        # Beside a pivot of rounding size there is nothing but rounding, unless the matrix is no covariance.
        below = jnp.where(small, 0.0, rest[1:, 0] / root)
        columns.append(jnp.concatenate([jnp.zeros(j, dtype), root[None], below]))
        marks.append(small)
        rest = rest[1:, 1:] - below[:, None] * below[None, :]
    return jnp.stack(columns, axis=1), jnp.stack(marks)


def _by_library(matrix: Float[Array, "d d"], floor: float) -> tuple[Float[Array, "d d"], Bool[Array, " d"]]:
    eye = jnp.eye(matrix.shape[0], dtype=matrix.dtype)
    trials = jnp.stack([matrix, matrix + jnp.sqrt(jnp.finfo(matrix.dtype).eps) * eye])
    lower, first = first_cholesky(trials)
    return lower, (jnp.diagonal(lower) ** 2 < floor) | ~first
