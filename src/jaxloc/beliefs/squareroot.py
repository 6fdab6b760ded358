"""Square roots of covariances that stay finite when a covariance is singular to rounding."""

import jax.numpy as jnp
from jax import lax
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float

_UNROLLED = 9  # up to here a loop of column steps beats the library call under vmap


def cholesky(covariance: Float[Array, "d d"]) -> Float[Array, "d d"]:
    """Lower triangular ``L`` with ``L L^T = covariance``.

    The matrix is scaled to unit diagonal and its pivots are kept above rounding (``d eps``), so that a covariance which
    is singular, or a hair from positive, still has a finite root with finite gradients.

    Args:
        covariance: "d d", symmetric; the lower triangle is read.

    Returns:
        "d d", lower triangular with positive diagonal.

    References:
        Golub and Van Loan, *Matrix Computations*, 2013, section 4.2.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> jl.beliefs.squareroot.cholesky(jnp.array([[4.0, 2.0], [2.0, 5.0]])).tolist()
        [[2.0, 0.0], [1.0, 2.0]]
    """
    info = jnp.finfo(covariance.dtype)
    size = covariance.shape[0]
    scale = jnp.sqrt(jnp.maximum(jnp.diagonal(covariance), float(info.tiny) ** 0.5))
    correlation = covariance / scale[:, None] / scale[None, :]
    factor = _columns if size <= _UNROLLED else _library
    return scale[:, None] * factor(correlation, size * float(info.eps))


def whiten(root: Float[Array, "d d"], residual: Float[Array, "d *k"]) -> Float[Array, "d *k"]:
    """``L^-1 r``: residuals in sigmas, for the lower triangular root of their covariance.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> jl.beliefs.squareroot.whiten(jnp.array([[2.0, 0.0], [1.0, 4.0]]), jnp.array([2.0, 5.0])).tolist()
        [1.0, 1.0]
    """
    if root.shape[0] > _UNROLLED:
        return solve_triangular(root, residual, lower=True)
    rows: list[Array] = []
    for i in range(root.shape[0]):
        rest = residual[i]
        for j in range(i):
            rest = rest - root[i, j] * rows[j]
        rows.append(rest / root[i, i])
    return jnp.stack(rows)


def solve(root: Float[Array, "d d"], right: Float[Array, "d *k"]) -> Float[Array, "d *k"]:
    """``(L L^T)^-1 b`` for a lower triangular root.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> jl.beliefs.squareroot.solve(jnp.array([[2.0, 0.0], [0.0, 4.0]]), jnp.array([4.0, 16.0])).tolist()
        [1.0, 1.0]
    """
    # The transposed system is lower triangular again when both its axes run backwards.
    return whiten(root.T[::-1, ::-1], whiten(root, right)[::-1])[::-1]


def _columns(matrix: Array, floor: float) -> Array:
    index, columns = jnp.arange(matrix.shape[0]), []
    for j in range(matrix.shape[0]):
        pivot = jnp.sqrt(jnp.maximum(matrix[j, j], floor))
        # Beside a pivot of rounding size there is nothing but rounding, unless the matrix is no covariance.
        below = jnp.where(matrix[j, j] > floor, matrix[:, j], 0.0) / pivot
        column = jnp.where(index > j, below, jnp.where(index == j, pivot, 0.0))
        columns.append(column)
        matrix = matrix - column[:, None] * column[None, :]
    return jnp.stack(columns, axis=1)


def _library(matrix: Array, floor: float) -> Array:
    eye = jnp.eye(matrix.shape[0], dtype=matrix.dtype)
    bad = ~jnp.all(jnp.isfinite(jnp.linalg.cholesky(lax.stop_gradient(matrix) + floor * eye)))
    # Not positive: the root of the diagonal is a finite stand-in.
    return jnp.linalg.cholesky(jnp.where(bad, eye, matrix) + floor * eye)
