"""Control over what XLA does: results that are computed once, and arrays that stay laid out over devices."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array


def compute_once(function: Callable[..., Array], *operands: Any) -> Array:
    """Evaluates `function(*operands)` once, into memory, before anything uses the result.

    XLA's CPU backend fuses elementwise operations into each of their consumers and repeats them there: an image that
    is halved and then differentiated costs 25 pixels for each pixel of each difference. `lax.optimization_barrier` is
    no remedy: the CPU pipeline of jaxlib 0.10 removes barriers before fusion (openxla/xla issue 20440, open, reports
    another pass that does not respect them). Fusion does not cross the boundary of a conditional, so this is one whose
    predicate is always true, which the compiler cannot prove. On other platforms, and in value and derivatives, it is
    the function itself.

    Args:
        function: the computation; one array out.
        operands: its arguments; at least one is a nonempty floating-point array.

    Returns:
        The function's result.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> jax.jit(lambda x: compute_once(jnp.cumsum, x) ** 2)(jnp.arange(4.0)).tolist()
        [0.0, 1.0, 9.0, 36.0]
    """
    number = next(x for x in operands if jnp.issubdtype(x.dtype, jnp.floating) and x.size)
    bits = lax.bitcast_convert_type(number.reshape(-1)[0], f"int{8 * number.dtype.itemsize}")
    # True whatever the number is, which the compiler does not know.
    always = lax.population_count(bits) < 99

    def branch(*operands: Any) -> Array:
        shape = eqx.filter_eval_shape(function, *operands)
        return lax.cond(always, function, lambda *_: jnp.zeros(shape.shape, shape.dtype), *operands)

    return lax.platform_dependent(*operands, cpu=branch, default=function)


def shard_like(new: Any, reference: Any) -> Any:
    """The arrays of a pytree, laid out over devices as the arrays of another, in order.

    Compilers may gather arrays that were indexed on each device, and JAX has no public function that asks for the
    layout of an array whose mesh has automatic axes. So each new array passes through a selection between itself and
    its reference, whose operands must be laid out alike; its predicate is always true, behind a barrier that keeps
    the compiler from folding it. On one device this does nothing.

    Args:
        new: pytree of arrays.
        reference: pytree with the layout: as many arrays, of the same shapes.

    Returns:
        The first pytree.
    """
    if jax.device_count() == 1:
        return new
    leaves, structure = jax.tree.flatten(new)
    keep = lax.optimization_barrier(jnp.ones((), bool))
    pairs = zip(leaves, jax.tree.leaves(reference), strict=True)
    return jax.tree.unflatten(structure, [jnp.where(keep, one, other.astype(one.dtype)) for one, other in pairs])
