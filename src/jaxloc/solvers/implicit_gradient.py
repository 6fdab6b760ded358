"""Derivatives of the solution of equations, by the implicit function theorem."""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from jaxloc import _tree as tree
from jaxloc.poses import retract


class Equations(eqx.Module):
    """Equations ``g(value, data) = 0``: the data are the array leaves of this record.

    Subclasses give the residual g and a linear solve with its derivative by the value; values that are not moved by
    `jaxloc.poses.retract` override ``move``.
    """

    @abstractmethod
    def residual(self, value: Any) -> Any:
        """G at a value: a pytree of arrays, one number for each unknown."""

    @abstractmethod
    def solve(self, value: Any, right: Any, ok: Bool[Array, ""]) -> Any:
        """The tangent ``(dg/dvalue)^-1 right`` at a solution; anything, but without raising, where not ``ok``."""

    def move(self, value: Any, delta: Any) -> Any:
        """The value moved along a tangent."""
        return retract(value, delta)


def attach_gradient(value: Any, equations: Equations, ok: Bool[Array, ""]) -> Any:
    """The value itself, with the derivative by the data that a solution of the equations has.

    ``g(value, data) = 0`` gives ``dvalue = -(dg/dvalue)^-1 (dg/ddata) ddata``. The rule calls itself on its own output,
    so that higher derivatives are right too. The derivative by the value that is given is zero.

    Args:
        value: a solution, a pytree with poses and arrays.
        equations: what it solves, with the data.
        ok: where False, the derivative is zero, whatever the data hold.

    Returns:
        The value.

    References:
        Blondel et al., "Efficient and modular implicit differentiation", NeurIPS 2022 [K-21].

    Example:
        >>> import jax, jax.numpy as jnp
        >>> class SquareRoot(Equations):
        ...     number: jax.Array
        ...     def residual(self, value):
        ...         return value**2 - self.number
        ...     def solve(self, value, right, ok):
        ...         return right / (2.0 * value)
        >>> ok = jnp.array(True)
        >>> slope = jax.grad(lambda number: attach_gradient(jnp.array([3.0]), SquareRoot(number), ok)[0])
        >>> round(float(slope(9.0)), 4)
        0.1667
    """
    return _attach(value, tree.detach_unless(ok, equations), ok)


@eqx.filter_custom_jvp
def _attach(value: Any, equations: Equations, ok: Bool[Array, ""]) -> Any:
    del equations, ok
    return value


@_attach.def_jvp
def _attach_jvp(primals: Any, tangents: Any) -> tuple[Any, Any]:
    value, equations, ok = primals
    value = _attach(value, equations, ok)
    is_none = lambda node: node is None  # noqa: E731
    moving = jax.tree.map(lambda t, leaf: None if t is None else leaf, tangents[1], equations, is_leaf=is_none)
    fixed = jax.tree.map(lambda t, leaf: leaf if t is None else None, tangents[1], equations, is_leaf=is_none)
    _, change = jax.jvp(lambda data: eqx.combine(data, fixed).residual(value), (moving,), (tangents[1],))
    delta = jax.tree.map(lambda leaf: jnp.where(ok, -leaf, 0.0), equations.solve(value, change, ok))
    still = jax.tree.map(jnp.zeros_like, delta)
    _, tangent = jax.jvp(lambda d: eqx.filter(equations.move(value, d), eqx.is_inexact_array), (still,), (delta,))
    return value, tangent
