"""Descent steps from the normal equations: Gauss-Newton, Newton, steepest descent, diagonal, Levenberg-Marquardt.

References:
    Baker and Matthews, "Lucas-Kanade 20 years on: a unifying framework", IJCV 56(3), 2004, section 4 [K-27].
"""

from abc import abstractmethod
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxloc import _linalg
from jaxloc._linalg import matmul
from jaxloc.alignment.lucas_kanade.normal_equations import Equations
from jaxloc.solvers.cholesky import factor


class Descent(eqx.Module):
    """Rule for a descent step.

    Attributes:
        newton: factor of the second-order part of the Hessian that it uses.
        guarded: whether steps may be rejected.
    """

    newton: eqx.AbstractVar[float]
    guarded: ClassVar[bool] = False

    @abstractmethod
    def solve(self, equations: Equations, damping: Float[Array, ""]) -> Float[Array, " d"]:
        """The step that is subtracted, in the tangent space."""

    def accepts(self, new: Equations, best: Equations) -> Bool[Array, ""]:
        """Whether the new warp is accepted; always, unless overridden."""
        del new, best
        return jnp.array(True)

    def damp(self, damping: Float[Array, ""], accepted: Bool[Array, ""]) -> Float[Array, ""]:
        """The damping of the next step."""
        del accepted
        return damping


class GaussNewtonStep(Descent):
    """Gauss-Newton approximation of the Hessian."""

    newton: ClassVar[float] = 0.0

    def solve(self, equations: Equations, damping: Float[Array, ""]) -> Float[Array, " d"]:
        """``H^-1 g``."""
        return factor(equations.hessian).solve(equations.gradient)


class NewtonStep(Descent):
    """Newton step with second derivatives of the image; noisy, and indefinite not far from the solution.

    Attributes:
        newton: 1 for the Hessian; -1 reverses its second-order part, which reproduces the curves of the paper; the true
            Hessian converges far worse there.
    """

    newton: float = eqx.field(static=True, default=1.0)

    def solve(self, equations: Equations, damping: Float[Array, ""]) -> Float[Array, " d"]:
        """``H^-1 g``, for indefinite H too."""
        matrix = equations.hessian
        scale = 1.0 / jnp.sqrt(jnp.maximum(jnp.abs(jnp.diagonal(matrix)), jnp.finfo(matrix.dtype).tiny))
        scaled = matrix * scale[:, None] * scale[None, :]
        return scale * _linalg.solve(scaled, scale * equations.gradient)


class SteepestDescentStep(Descent):
    """Along the gradient, with the step length of the Gauss-Newton Hessian."""

    newton: ClassVar[float] = 0.0

    def solve(self, equations: Equations, damping: Float[Array, ""]) -> Float[Array, " d"]:
        """``(g g / g H g) g``."""
        gradient = equations.gradient
        curvature = jnp.sum(gradient * matmul(equations.hessian, gradient))
        curved = curvature > 0
        return jnp.where(curved, jnp.sum(gradient**2) / jnp.where(curved, curvature, 1.0), 0.0) * gradient


class DiagonalStep(Descent):
    """Diagonal approximation of the Hessian.

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
    """Levenberg-Marquardt: steps that increase the cost are rejected and damped more.

    Attributes:
        initial_damping: fraction of the diagonal that is added to it.
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
        """Only steps that decrease the cost."""
        return new.mean_cost <= best.mean_cost

    def damp(self, damping: Float[Array, ""], accepted: Bool[Array, ""]) -> Float[Array, ""]:
        """A tenth after accepted steps, ten times after rejected ones."""
        return jnp.clip(jnp.where(accepted, 0.1 * damping, 10.0 * damping), 1e-7, 1e9)
