"""Derivatives of an adjusted bundle, by the implicit function theorem."""

import jax
from jaxtyping import Array, Bool

from jaxloc.refinement.bundle.problem import Bundle, BundleProblem
from jaxloc.refinement.bundle.schur import Tangent, eliminate, normal_equations
from jaxloc.refinement.bundle.structure import Structure
from jaxloc.solvers.implicit_gradient import Equations


class BundleEquations(Equations):
    """The equations of an adjusted bundle: the gradient of the exact objective along the tangent is zero.

    The exact Hessian is block-sparse like that of the steps (an arrow matrix), and is factored as they are.

    Attributes:
        problem: what was minimized.
        structure: its index tables.
    """

    problem: BundleProblem
    structure: Structure

    def residual(self, value: Bundle) -> Tangent:
        """Gradient of the objective, robust kernels included."""
        return Tangent(*self.problem.gradient(value, self.structure))

    def solve(self, value: Bundle, right: Tangent, ok: Bool[Array, ""]) -> Tangent:
        """By the exact Hessian; it is symmetric, so that the solve is its own transpose."""
        del ok
        _, _, arrow = normal_equations(self.problem, value, self.structure, exact=True)
        eliminated = eliminate(arrow, self.structure)
        return jax.lax.custom_linear_solve(arrow.product, right, lambda _, b: eliminated.solve(b), symmetric=True)

    def move(self, value: Bundle, delta: Tangent) -> Bundle:
        """The bundle with its poses and points moved."""
        return value.moved(delta.cameras, delta.points)
