"""Decompositions and solves by LAPACK, one matrix at a time on a CPU: batches of them can deadlock XLA.

jaxlib 0.10 splits a batched LAPACK call over the threads of XLA's CPU client, and the thread that makes the call waits
for the parts; when each thread waits in such a call, none is left for the parts (`docs/lapack_deadlock.md`). Under
`vmap` the functions of this module call LAPACK for one matrix after the other, which is never split. Small matrices
need no LAPACK: their elimination is vectorized over the batch. On accelerators batches stay batches.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Bool, Float

from jaxloc._linalg.products import matmul

_SMALL = 16  # rows; up to here, elimination in plain XLA operations


def _one_at_a_time(call: Callable) -> Callable:
    """A function of arrays that a batch evaluates one after the other on a CPU."""

    def in_turn(*arrays: Array) -> Any:
        return lax.map(lambda item: call(*item), arrays)

    single = custom_vmap(call)
    many = custom_vmap(lambda *arrays: lax.platform_dependent(*arrays, cpu=in_turn, default=jax.vmap(call)))

    @single.def_vmap
    def _(axis_size: int, in_batched: list[bool], *arrays: Array) -> tuple[Any, Any]:
        found = many(*_stacked(axis_size, in_batched, arrays))
        return found, jax.tree.map(lambda _: True, found)

    @many.def_vmap
    def _(axis_size: int, in_batched: list[bool], *arrays: Array) -> tuple[Any, Any]:
        # A batch of batches is one batch: XLA fails on products of what nested loops return.
        stacked = _stacked(axis_size, in_batched, arrays)
        sizes = stacked[0].shape[:2]
        found = many(*(array.reshape(sizes[0] * sizes[1], *array.shape[2:]) for array in stacked))
        found = jax.tree.map(lambda array: array.reshape(*sizes, *array.shape[1:]), found)
        return found, jax.tree.map(lambda _: True, found)

    return single


def _stacked(size: int, batched: list[bool], arrays: tuple[Array, ...]) -> list[Array]:
    """Arrays that all have the axis of the batch."""
    return [
        array if varies else jnp.broadcast_to(array, (size, *array.shape))
        for array, varies in zip(arrays, batched, strict=True)
    ]


@jax.custom_jvp
def first_cholesky(trials: Float[Array, "k d d"]) -> tuple[Float[Array, "d d"], Bool[Array, ""]]:
    """Cholesky factor of the first of several matrices that has one, and whether it is that of the first.

    Args:
        trials: symmetric matrices that differ by constants only; lower triangles are read. The derivative is that of
            the first.

    Returns:
        The factor, the identity where no matrix has one.

    Example:
        >>> import jax.numpy as jnp
        >>> lower, first = first_cholesky(jnp.array([[[-1.0]], [[4.0]]]))
        >>> lower.tolist(), bool(first)
        ([[2.0]], False)
    """
    return _first_cholesky(trials)


@_one_at_a_time
def _first_cholesky(trials: Array) -> tuple[Array, Array]:
    def attempt(index: int) -> Array:
        if index == trials.shape[0]:
            return jnp.eye(trials.shape[1], dtype=trials.dtype)
        lower = lax.linalg.cholesky(trials[index], symmetrize_input=False)
        return lax.cond(jnp.all(jnp.isfinite(lower)), lambda: lower, lambda: attempt(index + 1))

    lower = lax.linalg.cholesky(trials[0], symmetrize_input=False)
    first = jnp.all(jnp.isfinite(lower))
    return lax.cond(first, lambda: lower, lambda: attempt(1)), first


@first_cholesky.defjvp
def _first_cholesky_jvp(primals: tuple[Any], tangents: tuple[Any]) -> tuple[Any, Any]:
    """``dL = L phi(L^-1 dA L^-T)``, phi the lower triangle with half its diagonal."""
    lower, first = first_cholesky(primals[0])
    change = jnp.asarray(tangents[0])[0]
    half = solve_lower(lower, 0.5 * (change + change.T))
    inner = jnp.tril(solve_lower(lower, half.T))
    inner = inner - 0.5 * jnp.diag(jnp.diagonal(inner))
    return (lower, first), (matmul(lower, inner), jnp.zeros(first.shape, jax.dtypes.float0))


def solve_lower(lower: Float[Array, "d d"], right: Float[Array, "d *k"]) -> Float[Array, "d *k"]:
    """``L^-1 b`` for a lower triangular L, by substitution.

    Example:
        >>> import jax.numpy as jnp
        >>> solve_lower(jnp.array([[2.0, 0.0], [1.0, 4.0]]), jnp.array([2.0, 5.0])).tolist()
        [1.0, 1.0]
    """
    return _columns(right, lambda columns: _solve_linear(jnp.tril(lower), columns, _forward, _backward))


def solve(matrix: Float[Array, "d d"], right: Float[Array, "d *k"]) -> Float[Array, "d *k"]:
    """``A^-1 b`` by Gaussian elimination with partial pivoting; not finite for a singular matrix.

    Example:
        >>> import jax.numpy as jnp
        >>> solve(jnp.array([[0.0, 2.0], [1.0, 1.0]]), jnp.array([2.0, 3.0])).tolist()
        [2.0, 1.0]
    """
    method = _eliminate if matrix.shape[0] <= _SMALL else _solve_general
    return _columns(right, lambda columns: _solve_linear(matrix, columns, method, lambda a, b: method(a.T, b)))


def inverse(matrix: Float[Array, "d d"]) -> Float[Array, "d d"]:
    """``A^-1``; not finite for a singular matrix.

    Example:
        >>> import jax.numpy as jnp
        >>> inverse(jnp.array([[0.0, 2.0], [1.0, 0.0]])).tolist()
        [[0.0, 1.0], [0.5, 0.0]]
    """
    return solve(matrix, jnp.eye(matrix.shape[0], dtype=matrix.dtype))


@jax.custom_jvp
def eigh(matrix: Float[Array, "d d"]) -> tuple[Float[Array, " d"], Float[Array, "d d"]]:
    """Eigenvalues, in ascending order, and eigenvectors (columns) of a symmetric matrix.

    The derivative of eigenvectors leaves out directions among equal eigenvalues, where it does not exist.

    Example:
        >>> import jax.numpy as jnp
        >>> eigh(jnp.array([[2.0, 0.0], [0.0, 1.0]]))[0].tolist()
        [1.0, 2.0]
    """
    return _eigh(matrix)


@eigh.defjvp
def _eigh_jvp(primals: tuple[Any], tangents: tuple[Any]) -> tuple[Any, Any]:
    values, vectors = eigh(primals[0])
    change = jnp.asarray(tangents[0])
    inner = matmul(vectors.T, matmul(0.5 * (change + change.T), vectors))
    gaps = values[None, :] - values[:, None]
    apart = jnp.abs(gaps) > float(jnp.finfo(values.dtype).eps) * jnp.max(jnp.abs(values))
    turn = jnp.where(apart, 1.0 / jnp.where(apart, gaps, 1.0), 0.0) * inner
    return (values, vectors), (jnp.diagonal(inner), matmul(vectors, turn))


def svd(matrix: Float[Array, "m d"]) -> tuple[Float[Array, "m k"], Float[Array, " k"], Float[Array, "k d"]]:
    """Thin singular value decomposition ``A = U diag(s) V^T``: U, s in descending order, and V^T; without derivatives.

    Example:
        >>> import jax.numpy as jnp
        >>> svd(jnp.array([[3.0, 0.0], [0.0, 4.0]]))[1].tolist()
        [4.0, 3.0]
    """
    return _svd(lax.stop_gradient(matrix))


def qr(matrix: Float[Array, "m d"]) -> tuple[Float[Array, "m m"], Float[Array, "m d"]]:
    """Complete orthogonal decomposition ``A = Q R``, Q square; without derivatives.

    Example:
        >>> import jax.numpy as jnp
        >>> jnp.abs(qr(jnp.array([[3.0], [4.0]]))[1]).round(3).tolist()
        [[5.0], [0.0]]
    """
    matrix = lax.stop_gradient(matrix)
    return _reflect(matrix) if matrix.shape[0] <= _SMALL else _qr(matrix)


@_one_at_a_time
def triangular_factor(matrix: Float[Array, "m d"]) -> Float[Array, "k d"]:
    """R of ``A = Q R``, without derivatives; the signs of its rows are arbitrary.

    Example:
        >>> import jax.numpy as jnp
        >>> jnp.abs(triangular_factor(jnp.array([[3.0], [4.0]]))).tolist()
        [[5.0]]
    """
    return jnp.linalg.qr(matrix, mode="r")


def _columns(right: Array, call: Callable[[Array], Array]) -> Array:
    return call(right) if right.ndim == 2 else call(right[:, None])[:, 0]


def _solve_linear(matrix: Array, right: Array, forth: Callable, back: Callable) -> Array:
    """The solution with the derivatives of a linear equation, whatever the methods are for it and for its transpose."""
    return lax.custom_linear_solve(
        lambda x: matmul(matrix, x), right, lambda _, b: forth(matrix, b), lambda _, b: back(matrix, b)
    )


def _eliminate(matrix: Array, right: Array) -> Array:
    """Gauss-Jordan elimination with row pivoting, in operations that a batch vectorizes."""
    size = matrix.shape[0]
    rows = jnp.arange(size)

    def reduce(index: Any, system: Array) -> Array:
        column = jnp.where(rows >= index, jnp.abs(system[:, index]), -1.0)
        pivot = jnp.argmax(column)
        top, moved = system[pivot], system[index]
        system = jnp.where((rows == pivot)[:, None], moved[None], system)
        top = top / top[index]
        others = system - system[:, index][:, None] * top[None]
        return jnp.where((rows == index)[:, None], top[None], others)

    system = jnp.concatenate([matrix, right], axis=1)
    return lax.fori_loop(0, size, reduce, system)[:, size:]


def _reflect(matrix: Array) -> tuple[Array, Array]:
    """Householder's reflections, in operations that a batch vectorizes."""
    rows, columns = matrix.shape
    place = jnp.arange(rows)

    def reduce(index: Any, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        q, r = carry
        vector = jnp.where(place >= index, r[:, index], 0.0)
        length = jnp.sqrt(jnp.sum(vector * vector))
        head = r[index, index]
        vector = vector.at[index].add(jnp.where(head < 0, -length, length))
        squared = jnp.sum(vector * vector)
        scale = jnp.where(squared > 0, 2.0 / jnp.where(squared > 0, squared, 1.0), 0.0)
        r = r - scale * vector[:, None] * jnp.sum(vector[:, None] * r, axis=0)[None]
        q = q - scale * jnp.sum(q * vector[None], axis=1)[:, None] * vector[None]
        return q, r

    initial = jnp.eye(rows, dtype=matrix.dtype), matrix
    q, r = lax.fori_loop(0, min(rows, columns), reduce, initial)
    return q, jnp.triu(r)


@_one_at_a_time
def _forward(lower: Array, right: Array) -> Array:
    return jax.scipy.linalg.solve_triangular(lower, right, lower=True)


@_one_at_a_time
def _backward(lower: Array, right: Array) -> Array:
    return jax.scipy.linalg.solve_triangular(lower, right, lower=True, trans=1)


@_one_at_a_time
def _solve_general(matrix: Array, right: Array) -> Array:
    return jnp.linalg.solve(matrix, right)


@_one_at_a_time
def _eigh(matrix: Array) -> tuple[Array, Array]:
    values, vectors = jnp.linalg.eigh(matrix)
    return values, vectors


@_one_at_a_time
def _svd(matrix: Array) -> tuple[Array, Array, Array]:
    left, values, right = jnp.linalg.svd(matrix, full_matrices=False)
    return left, values, right


@_one_at_a_time
def _qr(matrix: Array) -> tuple[Array, Array]:
    q, r = jnp.linalg.qr(matrix, mode="complete")
    return q, r
