"""QR factorization of tall matrices, as a lineax solver of linear least squares that is safe in batches."""

from typing import Any

import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, Float

from jaxloc._linalg import back_substitution, triangular_factor


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

    def init(self, operator: lx.AbstractLinearOperator, options: dict[str, Any]) -> Float[Array, "m d"]:
        """The operator's matrix."""
        del options
        return operator.as_matrix()

    def compute(
        self, state: Float[Array, "m d"], vector: Float[Array, " m"], options: dict[str, Any]
    ) -> tuple[Float[Array, " d"], lx.RESULTS, dict[str, Any]]:
        """Factors the matrix with the right-hand side beside it, which needs no orthogonal factor."""
        del options
        size = state.shape[1]
        missing = max(size - state.shape[0], 0)
        state, vector = jnp.pad(state, ((0, missing), (0, 0))), jnp.pad(vector, (0, missing))
        factor = triangular_factor(jnp.concatenate([state, vector[:, None]], axis=1))
        return back_substitution(factor[:size, :size].T, factor[:size, size]), lx.RESULTS.successful, {}

    def transpose(self, state: Float[Array, "m d"], options: dict[str, Any]) -> Any:
        """Not available: derivatives of estimates do not pass through the steps of a solver."""
        raise NotImplementedError("Solves by QR have no transpose.")

    def conj(self, state: Float[Array, "m d"], options: dict[str, Any]) -> tuple[Float[Array, "m d"], dict[str, Any]]:
        """The matrix is real."""
        return state, options

    def assume_full_rank(self) -> bool:
        """Columns are independent."""
        return True
