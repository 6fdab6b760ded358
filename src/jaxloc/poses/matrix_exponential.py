"""Exponential and logarithm of small matrices with a fixed number of products, batched and differentiable."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxloc import _linalg
from jaxloc._arguments import checked
from jaxloc._linalg import matmul

_HALVINGS, _TERMS = 4, 9
_ROOTS, _ROOT_STEPS, _ODD_TERMS = 3, 7, 7


@checked
def exponential_less_identity(matrix: Float[Array, "k k"]) -> Float[Array, "k k"]:
    """``exp(A) - I``, exact to rounding for norms up to about 6.

    Taylor series of a sixteenth of A, then four squarings ``(I + E)^2 = I + (2 E + E^2)``; without the
    identity, small exponents have no cancellation.

    References:
        Moler and Van Loan, "Nineteen dubious ways to compute the exponential of a matrix", 2003, method 3.

    Example:
        >>> import jax.numpy as jnp
        >>> small = exponential_less_identity(jnp.array([[1e-10]]))
        >>> round(1e10 * float(small[0, 0]), 4)
        1.0
    """
    part = matrix / 2.0**_HALVINGS
    eye = jnp.eye(matrix.shape[0], dtype=matrix.dtype)
    series = eye
    for order in range(_TERMS, 1, -1):
        series = eye + matmul(part, series) / order
    result = matmul(part, series)
    for _ in range(_HALVINGS):
        result = 2.0 * result + matmul(result, result)
    return result


@checked
def logarithm(matrix: Float[Array, "k k"]) -> Float[Array, "k k"]:
    """The principal logarithm of a matrix without eigenvalues on the negative real axis.

    After three square roots by Denman and Beavers' iteration the matrix is near the identity, where
    ``log M = 2 artanh((M - I)(M + I)^-1)`` converges fast. The result is not finite for a singular matrix.

    References:
        Higham, *Functions of Matrices*, 2008, sections 6.3 and 11.5.

    Example:
        >>> import jax.numpy as jnp
        >>> round(float(logarithm(jnp.array([[2.0]]))[0, 0]), 4)
        0.6931
    """
    for _ in range(_ROOTS):
        matrix = _square_root(matrix)
    eye = jnp.eye(matrix.shape[0], dtype=matrix.dtype)
    z = _linalg.solve(matrix + eye, matrix - eye)
    squared = matmul(z, z)
    series = eye / (2 * _ODD_TERMS + 1)
    for order in range(2 * _ODD_TERMS - 1, 0, -2):
        series = eye / order + matmul(squared, series)
    return 2.0 ** (_ROOTS + 1) * matmul(z, series)


def _square_root(matrix: Float[Array, "k k"]) -> Float[Array, "k k"]:
    root, other = matrix, jnp.eye(matrix.shape[0], dtype=matrix.dtype)
    for _ in range(_ROOT_STEPS):
        root, other = 0.5 * (root + _linalg.inverse(other)), 0.5 * (other + _linalg.inverse(root))
    return root
