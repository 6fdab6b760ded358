"""Square roots of covariances: Cholesky, triangularization, solves and downdates, finite for singular ones."""

from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Float

from jaxloc import _linalg
from jaxloc._linalg import matmul

_UNROLLED_ROWS = 14  # up to here a loop of row steps beats the library's orthogonal factorization under vmap
_SMALLEST_STACK = 16  # matrices; below, the batch would fill no vector registers
_LARGEST_PRODUCT = 16  # columns; beyond, the library's product


def cholesky(covariance: Float[Array, "d d"]) -> Float[Array, "d d"]:
    """Lower triangular ``L`` with ``L L^T = covariance``.

    The matrix is scaled to unit diagonal and its pivots are kept above rounding (``d eps``), so that a covariance which
    is singular, or indefinite by rounding, still has a finite root with finite gradients. Non-finite entries give NaN.

    Args:
        covariance: "d d", symmetric; the lower triangle is read.

    Returns:
        "d d", lower triangular with positive diagonal.

    References:
        Golub and Van Loan, *Matrix Computations*, 2013, section 4.2.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> jl.beliefs.square_root.cholesky(jnp.array([[4.0, 2.0], [2.0, 5.0]])).tolist()
        [[2.0, 0.0], [1.0, 2.0]]
    """
    info = jnp.finfo(covariance.dtype)
    size = covariance.shape[0]
    floor = size * float(info.eps)
    variances = jnp.diagonal(covariance)
    variances = jnp.where(variances > -jnp.inf, variances, jnp.nan)
    scale = jnp.sqrt(jnp.maximum(variances, float(info.tiny) ** 0.5))
    correlation = covariance / scale[:, None] / scale[None, :]
    if size > _linalg.UNROLLED:  # the library's factorization has no floor of its own
        correlation = correlation + floor * jnp.eye(size, dtype=covariance.dtype)
    return scale[:, None] * _linalg.cholesky(correlation, floor)[0]


def whiten(root: Float[Array, "d d"], residual: Float[Array, "d *k"]) -> Float[Array, "d *k"]:
    """``L^-1 r``: whitened residuals, for the lower triangular root of their covariance.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> jl.beliefs.square_root.whiten(jnp.array([[2.0, 0.0], [1.0, 4.0]]), jnp.array([2.0, 5.0])).tolist()
        [1.0, 1.0]
    """
    return _linalg.forward_substitution(root, residual)


def solve(root: Float[Array, "d d"], right: Float[Array, "d *k"]) -> Float[Array, "d *k"]:
    """``(L L^T)^-1 b`` for a lower triangular root.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> jl.beliefs.square_root.solve(jnp.array([[2.0, 0.0], [0.0, 4.0]]), jnp.array([4.0, 16.0])).tolist()
        [1.0, 1.0]
    """
    return _linalg.back_substitution(root, whiten(root, right))


@jax.custom_jvp
def triangularize(deviations: Float[Array, "d k"]) -> Float[Array, "d d"]:
    """Lower triangular ``L`` with ``L L^T = A A^T``, by orthogonal transformations of ``A`` itself (QR).

    The product ``A A^T`` is never formed, so the root has the accuracy of ``A``: in float32 a covariance whose largest
    and smallest variances are ``1e10`` apart keeps its small directions, which a Cholesky factor would lose. Rows may
    be zero or depend on others; values and derivatives stay finite. (Where a pivot is zero the root is not
    differentiable, and the derivative is that of the other pivots.)

    Args:
        deviations: "d k", any k; scaled deviations, or roots of covariances side by side.

    Returns:
        "d d", lower triangular with a nonnegative diagonal.

    References:
        Björck, "Solving linear least squares problems by Gram-Schmidt orthogonalization", BIT 1967 (the triangular
        factor is as accurate as Householder's); Kaminski, Bryson and Schmidt, "Discrete square root filtering", 1971.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> jl.beliefs.square_root.triangularize(jnp.array([[3.0, 4.0], [4.0, -3.0]])).round(3).tolist()
        [[5.0, 0.0], [0.0, 5.0]]
    """
    return _by_rows(deviations) if deviations.shape[0] <= _UNROLLED_ROWS else _by_library(deviations)


@triangularize.defjvp
def _triangularize_jvp(primals: tuple[Any], tangents: tuple[Any]) -> tuple[Array, Array]:
    """With ``A = L Q``: ``dA Q^T = dL + L W``, where the rotation ``W`` of the rows of Q is antisymmetric.

    The part above the diagonal of ``L^-1 dA Q^T`` is that of W, and W gives dL.
    """
    (a,), (da,) = primals, tangents
    root = triangularize(a)
    size = root.shape[0]
    # A row that depends linearly on those above it has no direction of its own.
    floor = 8.0 * float(jnp.finfo(a.dtype).eps) * jnp.sqrt(jnp.sum(lax.stop_gradient(a) ** 2, axis=1))
    free = (jnp.diagonal(root) > floor)[:, None]
    eye = jnp.eye(size, dtype=a.dtype)
    # One inverse, and products only by the tangent: their transposes are products again, quick to compile.
    inverse = jnp.where(free, whiten(jnp.where(free, root, eye), eye), 0.0)
    inverse = jnp.where(free.T, inverse, 0.0)
    along = matmul(jnp.asarray(da), matmul(inverse, a).T)
    upper = jnp.triu(matmul(inverse, along), 1)
    return root, jnp.tril(along - matmul(root, upper - upper.T))


@jax.custom_jvp
def product(a: Float[Array, "d k"], b: Float[Array, "k *n"]) -> Float[Array, "d *n"]:
    """``A B`` of small matrices at full precision, fast in batches.

    Batched on both sides, a matrix product is a loop of library calls on a CPU; here it is one vectorized loop.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> jl.beliefs.square_root.product(jnp.array([[1.0, 2.0]]), jnp.array([3.0, 4.0])).tolist()
        [11.0]
    """
    if a.shape[1] > _LARGEST_PRODUCT:
        return matmul(a, b)
    columns = b if b.ndim == 2 else b[:, None]
    terms = [a[:, j, None] * columns[None, j] for j in range(a.shape[1])]
    return sum(terms[1:], terms[0]).reshape(a.shape[0], *b.shape[1:])


@product.defjvp
def _product_jvp(primals: tuple[Any, Any], tangents: tuple[Any, Any]) -> tuple[Array, Array]:
    (a, b), (da, db) = primals, tangents
    return product(a, b), matmul(jnp.asarray(da), b) + matmul(a, jnp.asarray(db))


def downdate(root: Float[Array, "d d"], vector: Float[Array, " d"]) -> Float[Array, "d d"]:
    """Cholesky downdate: lower triangular root of ``L L^T - x x^T``, finite in any case.

    Where the difference is not positive definite, the vector is shortened until it is, up to rounding.

    Args:
        root: lower triangular L.
        vector: x.

    References:
        Gill, Golub, Murray and Saunders, "Methods for modifying matrix factorizations", 1974.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> jl.beliefs.square_root.downdate(5.0 * jnp.eye(2), jnp.array([0.0, 3.0])).round(3).tolist()
        [[5.0, 0.0], [0.0, 4.0]]
    """
    size = root.shape[0]
    eye = jnp.eye(size, dtype=root.dtype)
    safe = jnp.where((jnp.diagonal(root) > 0.0)[:, None], root, eye)
    white = jnp.where(jnp.diagonal(root) > 0.0, whiten(safe, vector), 0.0)
    limit = 1.0 - 4.0 * size * float(jnp.finfo(root.dtype).eps)
    length = jnp.sum(white**2)
    white = white * jnp.sqrt(jnp.where(length > limit, limit / jnp.where(length > limit, length, 1.0), 1.0))
    return matmul(root, cholesky(eye - white[:, None] * white[None, :]))


@custom_vmap
def _by_rows(rows: Array) -> Array:
    return _gram_schmidt(rows)


@_by_rows.def_vmap
def _(axis_size: int, in_batched: list[bool], rows: Array) -> tuple[Array, bool]:
    del axis_size, in_batched
    return _by_rows_stacked(rows), True


@custom_vmap
def _by_rows_stacked(stack: Array) -> Array:
    return _gram_schmidt_stacked(stack) if stack.shape[0] >= _SMALLEST_STACK else jax.vmap(_gram_schmidt)(stack)


@_by_rows_stacked.def_vmap
def _(axis_size: int, in_batched: list[bool], stacks: Array) -> tuple[Array, bool]:
    del in_batched
    roots = _by_rows_stacked(stacks.reshape(-1, *stacks.shape[2:]))
    return roots.reshape(axis_size, -1, *roots.shape[1:]), True


def _gram_schmidt(rows: Array) -> Array:
    """Modified Gram-Schmidt: the norm of each row, and the projections of the later rows onto it."""
    size, columns = rows.shape[0], []
    for i in range(size):
        first, rest = rows[0], rows[1:]
        length = jnp.sqrt(jnp.sum(first * first))
        direction = first / jnp.where(length > 0.0, length, 1.0)
        parts = jnp.sum(rest * direction[None, :], axis=1)
        columns.append(jnp.concatenate([jnp.zeros(i, rows.dtype), length[None], parts]))
        rows = rest - parts[:, None] * direction[None, :]
    return jnp.stack(columns, axis=1)


def _gram_schmidt_stacked(stack: Array) -> Array:
    """`_gram_schmidt` with the batch along the last axis, where it fills vector registers: several times as fast."""
    left = [jnp.moveaxis(stack[:, i], 0, -1) for i in range(stack.shape[1])]
    columns = []
    for i in range(stack.shape[1]):
        first, *rest = left
        length = jnp.sqrt(jnp.sum(first * first, axis=0))
        direction = first / jnp.where(length > 0.0, length, 1.0)[None]
        parts = [jnp.sum(row * direction, axis=0) for row in rest]
        left = [row - part[None] * direction for row, part in zip(rest, parts, strict=True)]
        columns.append(jnp.stack([jnp.zeros_like(length)] * i + [length, *parts], axis=-1))
    # Without the barrier, consumers are fused with the end of this loop and recompute it.
    return lax.optimization_barrier(jnp.stack(columns, axis=-1))


def _by_library(rows: Array) -> Array:
    upper: Any = _linalg.triangular_factor(rows.T)
    signed = upper * jnp.where(jnp.diagonal(upper) < 0.0, -1.0, 1.0)[:, None]
    missing = max(rows.shape[0] - rows.shape[1], 0)
    return jnp.pad(signed, ((0, missing), (0, 0))).T
