"""Five ways from the normal equations to a step.

References:
    Baker and Matthews, "Lucas-Kanade 20 years on: a unifying framework", IJCV 56(3), 2004, section 4 [K-27].
"""

from abc import abstractmethod
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxloc._linalg import matmul
from jaxloc.alignment.lucas_kanade.normal_equations import Equations
from jaxloc.solvers.cholesky import factor


class Descent(eqx.Module):
    """A way down.

    Attributes:
        newton: what it takes of the second derivatives' part of the Hessian: nothing, or all of it.
        guarded: whether it takes steps back.
    """

    newton: eqx.AbstractVar[float]
    guarded: ClassVar[bool] = False

    @abstractmethod
    def solve(self, equations: Equations, damping: Float[Array, ""]) -> Float[Array, " d"]:
        """The tangent that is to be taken off."""

    def accepts(self, new: Equations, best: Equations) -> Bool[Array, ""]:
        """Whether to go on from the new place; always, unless overridden."""
        del new, best
        return jnp.array(True)

    def damp(self, damping: Float[Array, ""], accepted: Bool[Array, ""]) -> Float[Array, ""]:
        """The damping of the next step."""
        del accepted
        return damping


class GaussNewtonStep(Descent):
    """The squared first derivatives stand for the Hessian."""

    newton: ClassVar[float] = 0.0

    def solve(self, equations: Equations, damping: Float[Array, ""]) -> Float[Array, " d"]:
        """``H^-1 g``."""
        return factor(equations.hessian).solve(equations.gradient)


class NewtonStep(Descent):
    """The whole Hessian, second derivatives of the image included: noisy, and indefinite not far from the answer.

    Attributes:
        newton: 1 for the Hessian; -1 turns its second-order part round. Only so are the curves of the paper met: the
            true Hessian does far worse on them.
    """

    newton: float = eqx.field(static=True, default=1.0)

    def solve(self, equations: Equations, damping: Float[Array, ""]) -> Float[Array, " d"]:
        """``H^-1 g``, also where H has negative eigenvalues."""
        matrix = equations.hessian
        scale = 1.0 / jnp.sqrt(jnp.maximum(jnp.abs(jnp.diagonal(matrix)), jnp.finfo(matrix.dtype).tiny))
        scaled = matrix * scale[:, None] * scale[None, :]
        return scale * jnp.linalg.solve(scaled, scale * equations.gradient)


class SteepestDescentStep(Descent):
    """Along the gradient, as far as the Gauss-Newton Hessian tells."""

    newton: ClassVar[float] = 0.0

    def solve(self, equations: Equations, damping: Float[Array, ""]) -> Float[Array, " d"]:
        """``(g g / g H g) g``."""
        gradient = equations.gradient
        bend = jnp.sum(gradient * matmul(equations.hessian, gradient))
        curved = bend > 0
        return jnp.where(curved, jnp.sum(gradient**2) / jnp.where(curved, bend, 1.0), 0.0) * gradient


class DiagonalStep(Descent):
    """Each direction by itself.

    Attributes:
        newton: 0 for the diagonal of the Gauss-Newton Hessian, otherwise as in `NewtonStep`.
    """

    newton: float = eqx.field(static=True, default=0.0)

    def solve(self, equations: Equations, damping: Float[Array, ""]) -> Float[Array, " d"]:
        """``g_i / H_ii``."""
        diagonal = jnp.diagonal(equations.hessian)
        curved = jnp.abs(diagonal) > jnp.finfo(diagonal.dtype).tiny
        return jnp.where(curved, equations.gradient / jnp.where(curved, diagonal, 1.0), 0.0)


class LevenbergMarquardtStep(Descent):
    """Gauss-Newton, damped more after each step that made things worse, and that step is taken back.

    Attributes:
        initial_damping: part of the diagonal that is added to it.
    """

    initial_damping: float = eqx.field(static=True, default=1e-3)

    newton: ClassVar[float] = 0.0
    guarded: ClassVar[bool] = True

    def solve(self, equations: Equations, damping: Float[Array, ""]) -> Float[Array, " d"]:
        """``(H + damping diag H)^-1 g``."""
        matrix = equations.hessian
        added = self.initial_damping * damping * jnp.diagonal(matrix)
        return factor(matrix + jnp.diag(added)).solve(equations.gradient)

    def accepts(self, new: Equations, best: Equations) -> Bool[Array, ""]:
        """Only downhill."""
        return new.mean_cost <= best.mean_cost

    def damp(self, damping: Float[Array, ""], accepted: Bool[Array, ""]) -> Float[Array, ""]:
        """A tenth, or ten times."""
        return jnp.clip(jnp.where(accepted, 0.1 * damping, 10.0 * damping), 1e-7, 1e9)
