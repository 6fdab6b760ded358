"""QR factorization of tall matrices, as a lineax solver of linear least squares that is safe in batches."""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, Float

from jaxloc._linalg import back_substitution, triangular_factor


class Rows(eqx.Module):
    """The matrix of a linear operator, and what its argument looks like.

    Args:
        matrix: "m d".
        leaves: shapes of the arrays of the argument, d numbers in all.
        tree: its pytree.
    """

    matrix: Float[Array, "m d"]
    leaves: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    tree: Any = eqx.field(static=True)

    def unravel(self, flat: Float[Array, " d"]) -> Any:
        """The argument from its numbers in a row."""
        ends = [0]
        for shape in self.leaves:
            ends.append(ends[-1] + math.prod(shape))
        parts = [flat[a:b].reshape(s) for a, b, s in zip(ends[:-1], ends[1:], self.leaves, strict=True)]
        return jax.tree.unflatten(self.tree, parts)


class QR(lx.AbstractLinearSolver):
    """Householder's QR factorization as a lineax solver of least-squares steps on the Jacobian.

    Its error grows with the condition number of the Jacobian, that of `Cholesky` with its square; it costs several
    times as much. (Batches of ``lineax.QR()`` solve the same, but can deadlock XLA's CPU client.) The solution of a
    system without full column rank is not finite.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl, lineax as lx
        >>> rows = jnp.array([[1.0, 0.0], [1.0, 1.0], [1.0, 2.0]])
        >>> target = jnp.array([1.0, 3.0, 5.0])
        >>> lx.linear_solve(lx.MatrixLinearOperator(rows), target, jl.solvers.QR()).value.round(4).tolist()
        [1.0, 2.0]
    """

    def init(self, operator: lx.AbstractLinearOperator, options: dict[str, Any]) -> Rows:
        """The operator's matrix."""
        del options
        leaves, tree = jax.tree.flatten(operator.in_structure())
        return Rows(operator.as_matrix(), tuple(leaf.shape for leaf in leaves), tree)

    def compute(self, state: Rows, vector: Any, options: dict[str, Any]) -> tuple[Any, lx.RESULTS, dict[str, Any]]:
        """Factors the matrix with the right-hand side beside it, which needs no orthogonal factor."""
        del options
        right = jnp.concatenate([jnp.ravel(leaf) for leaf in jax.tree.leaves(vector)])
        rows, size = state.matrix.shape
        missing = max(size - rows, 0)
        matrix, right = jnp.pad(state.matrix, ((0, missing), (0, 0))), jnp.pad(right, (0, missing))
        factor = triangular_factor(jnp.concatenate([matrix, right[:, None]], axis=1))
        solution = back_substitution(factor[:size, :size].T, factor[:size, size])
        return state.unravel(solution), lx.RESULTS.successful, {}

    def transpose(self, state: Rows, options: dict[str, Any]) -> Any:
        """Not available: derivatives of estimates do not pass through the steps of a solver."""
        raise NotImplementedError("Solves by QR have no transpose.")

    def conj(self, state: Rows, options: dict[str, Any]) -> tuple[Rows, dict[str, Any]]:
        """The matrix is real."""
        return state, options

    def assume_full_rank(self) -> bool:
        """Columns are independent."""
        return True
