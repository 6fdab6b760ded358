"""Linear algebra that all rooms share: precise products, decompositions and solves that are safe in batches."""

from jaxloc._linalg.factorization import UNROLLED, back_substitution, cholesky, forward_substitution
from jaxloc._linalg.lapack import eigh, first_cholesky, inverse, qr, solve, solve_lower, svd, triangular_factor
from jaxloc._linalg.products import matmul

__all__ = [
    "UNROLLED",
    "back_substitution",
    "cholesky",
    "eigh",
    "first_cholesky",
    "forward_substitution",
    "inverse",
    "matmul",
    "qr",
    "solve",
    "solve_lower",
    "svd",
    "triangular_factor",
]
