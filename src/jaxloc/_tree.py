"""Selection and masking of whole pytrees, and the guard of all recursive estimators against non-finite numbers.

A step of a filter or tracker that meets NaN, infinity or overflow is treated in three parts: inputs are replaced by
safe ones before it (`finite_or_zero`, `within_range`), derivatives are cut where the step is not usable (`protect`),
and its result is then replaced by a fallback (`where`).
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Bool


def largest(dtype: Any) -> float:
    """Bound of supported numbers: products of four of them, as in derivatives of covariances, do not overflow.

    Example:
        >>> f"{largest('float32'):.1e}"
        '4.3e+09'
    """
    return float(jnp.finfo(dtype).max) ** 0.25


def where(condition: Bool[Array, ""], yes: Any, no: Any) -> Any:
    """`jax.numpy.where` on every array of two pytrees of one structure.

    Example:
        >>> import jax.numpy as jnp
        >>> where(jnp.array(True), (jnp.array(1.0), jnp.array(2)), (jnp.array(3.0), jnp.array(4)))[1].item()
        2
    """
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)


def finite_or_zero(tree: Any) -> Any:
    """The pytree with zero in place of NaN and infinity.

    Example:
        >>> import jax.numpy as jnp
        >>> finite_or_zero(jnp.array([1.0, jnp.nan])).tolist()
        [1.0, 0.0]
    """
    return jax.tree.map(lambda a: jnp.where(jnp.isfinite(a), a, 0.0) if eqx.is_inexact_array(a) else a, tree)


def detach_unless(ok: Bool[Array, ""], tree: Any) -> Any:
    """The pytree itself, without derivatives where ``ok`` is False: NaN cotangents are cut there too.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> float(jax.grad(lambda x: detach_unless(jnp.array(False), x))(2.0))
        0.0
    """
    return jax.tree.map(lambda a: jnp.where(ok, a, jax.lax.stop_gradient(a)) if eqx.is_inexact_array(a) else a, tree)


def all_finite(tree: Any) -> Bool[Array, ""]:
    """Whether all floating-point numbers of a pytree are finite; without derivatives.

    Example:
        >>> import jax.numpy as jnp
        >>> bool(all_finite((jnp.ones(2), jnp.array(jnp.inf))))
        False
    """
    leaves = [jax.lax.stop_gradient(leaf) for leaf in jax.tree.leaves(tree) if eqx.is_inexact_array(leaf)]
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in leaves]))


def within_range(tree: Any) -> Bool[Array, ""]:
    """Whether all floating-point numbers of a pytree are finite and below `largest`; without derivatives.

    Example:
        >>> import jax.numpy as jnp
        >>> bool(within_range(jnp.ones(2))), bool(within_range(jnp.array([1.0, 1e30])))
        (True, False)
    """
    return _all([jnp.all(_inside(leaf)) for leaf in jax.tree.leaves(tree) if eqx.is_inexact_array(leaf)])


def slots_within_range(tree: Any) -> Bool[Array, " n"]:
    """`within_range` of each entry of a stack.

    Example:
        >>> import jax.numpy as jnp
        >>> slots_within_range(jnp.array([[1.0, 2.0], [jnp.nan, 0.0]])).tolist()
        [True, False]
    """
    return jax.vmap(within_range)(tree)


def in_range_or_zero(tree: Any) -> Any:
    """The pytree with zero in place of NaN, infinity and numbers above `largest`; these have no derivatives.

    Example:
        >>> import jax.numpy as jnp
        >>> in_range_or_zero(jnp.array([1.0, jnp.nan, 1e30])).tolist()
        [1.0, 0.0, 0.0]
    """
    return jax.tree.map(lambda a: jnp.where(_inside(a), a, 0.0) if eqx.is_inexact_array(a) else a, tree)


def protect(function: Callable[..., tuple[Bool[Array, ""], Any]], *args: Any) -> tuple[Bool[Array, ""], Any]:
    """``function(*args)``, with all derivatives cut where it is not usable.

    Whether a step overflows is known only after it, when derivatives that are NaN can no longer be kept out by
    replacing its inputs. So they are cut on both sides of it: tangents (and cotangents) are zero where the function
    says that it is not usable, and for the entries of its inputs whose squares overflow. Nothing is computed twice.

    Args:
        function: of pytrees; it returns whether its value is usable, and the value, a pytree of arrays.
        args: of the function. Derivatives by arrays that it closes over are cut too.

    Returns:
        What the function returns. The caller replaces values that are not usable.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> def root(x):
        ...     return x > 0.0, jnp.sqrt(x)
        >>> [float(jax.grad(lambda x: protect(root, x)[1])(x)) for x in (0.25, 0.0)]
        [1.0, 0.0]
    """
    dynamic, static = eqx.partition(args, eqx.is_array)
    leaves, structure = jax.tree.flatten(dynamic)

    def flat(*values):
        return function(*eqx.combine(jax.tree.unflatten(structure, values), static))

    if not any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
        return flat(*leaves)
    # A custom derivative takes all that it depends on as arguments.
    hoisted, closed_over = jax.closure_convert(flat, *leaves)
    step = jax.custom_jvp(hoisted)
    step.defjvp(lambda primals, tangents: _cut_jvp(hoisted, primals, tangents), symbolic_zeros=True)
    return jax.tree.map(jnp.asarray, step(*leaves, *closed_over))


def _cut_jvp(function: Callable, primals: tuple, tangents: tuple) -> tuple[Any, Any]:
    primals = tuple(jnp.asarray(primal) for primal in primals)
    moving = [i for i, tangent in enumerate(tangents) if not isinstance(tangent, SymbolicZero)]

    def of_moving(*values):
        inputs = list(primals)
        for i, value in zip(moving, values, strict=True):
            inputs[i] = value
        return function(*inputs)

    found, push = jax.linearize(of_moving, *[primals[i] for i in moving])
    usable = jax.lax.stop_gradient(found[0])
    pushed = push(*[jnp.where(usable & _square_is_finite(primals[i]), tangents[i], 0.0) for i in moving])
    return found, jax.tree.map(lambda a, t: jnp.where(usable, t, 0.0) if eqx.is_inexact_array(a) else t, found, pushed)


def _inside(leaf: Any) -> Bool[Array, "..."]:
    # NaN compares as False.
    return jnp.abs(jax.lax.stop_gradient(leaf)) < largest(leaf.dtype)


def _square_is_finite(leaf: Any) -> Bool[Array, "..."]:
    return jnp.abs(jax.lax.stop_gradient(leaf)) < float(jnp.finfo(leaf.dtype).max) ** 0.5


def _all(marks: list[Array]) -> Bool[Array, ""]:
    return jnp.all(jnp.stack(marks)) if marks else jnp.array(True)
