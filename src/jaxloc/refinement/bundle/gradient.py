"""Derivatives of an adjusted bundle, by the implicit function theorem."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from jaxloc.refinement.bundle.problem import Bundle, BundleProblem
from jaxloc.refinement.bundle.schur import Tangent, eliminate, normal_equations
from jaxloc.refinement.bundle.structure import Structure


@eqx.filter_custom_jvp
def attach_gradient(value: Bundle, problem: BundleProblem, structure: Structure, ok: Bool[Array, ""]) -> Bundle:
    """The bundle itself, with the derivative that a minimum of the problem has.

    With ``g(d, p)`` the gradient of the exact objective along the tangent, ``g(0, p) = 0`` gives
    ``dd = -H^-1 (dg/dp) dp``. The exact Hessian has the shape of the arrow too, so it is factored as steps are.

    Args:
        value: a minimum.
        problem: of what.
        structure: its tables.
        ok: where False, the derivative is zero.

    Returns:
        The value.
    """
    del problem, structure, ok
    return value


@attach_gradient.def_jvp
def _attach_gradient_jvp(primals: Any, tangents: Any) -> tuple[Any, Any]:
    value, problem, structure, ok = primals
    value = attach_gradient(value, problem, structure, ok)
    is_none = lambda node: node is None  # noqa: E731
    pick = lambda tangent, leaf: None if tangent is None else leaf  # noqa: E731
    moving = jax.tree.map(pick, tangents[1], problem, is_leaf=is_none)
    fixed = jax.tree.map(lambda tangent, leaf: leaf if tangent is None else None, tangents[1], problem, is_leaf=is_none)

    def slope(perturbed: Any) -> Tangent:
        return Tangent(*eqx.combine(perturbed, fixed).gradient(value, structure))

    _, change = jax.jvp(slope, (moving,), (tangents[1],))
    delta = jax.tree.map(lambda leaf: jnp.where(ok, -leaf, 0.0), _solve_exact(problem, value, structure, change))
    still = jnp.zeros_like(delta.cameras), jnp.zeros_like(delta.points)
    _, tangent = jax.jvp(value.moved, still, (delta.cameras, delta.points))
    return value, tangent


def _solve_exact(problem: BundleProblem, value: Bundle, structure: Structure, change: Tangent) -> Tangent:
    """The inverse of the exact Hessian times a vector; symmetric, so that it is its own transpose."""
    _, _, arrow = normal_equations(problem, value, structure, exact=True)
    eliminated = eliminate(arrow, structure)
    return jax.lax.custom_linear_solve(arrow.product, change, lambda _, right: eliminated.solve(right), symmetric=True)
