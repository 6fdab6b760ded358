"""Keeping a computation apart from what uses its result, where a compiler would merge them and repeat it."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array


def apart(function: Callable[..., Array], *operands: Any) -> Array:
    """Computes `function(*operands)` once, in memory, before anything uses it.

    On a processor XLA merges elementwise operations with those that use them, and works them out anew for each use: an
    image that is halved and then differentiated costs 25 pixels for each pixel of each difference, one by one.
    `lax.optimization_barrier` is dropped before that happens. Branches are not looked into, so this is one that is
    always taken. Elsewhere, and in its value and derivatives, it is the function itself.

    Args:
        function: What is computed.
        operands: Its arguments; at least one array of floating point numbers is not empty.

    Returns:
        The function's result.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> jax.jit(lambda x: apart(jnp.cumsum, x) ** 2)(jnp.arange(4.0)).tolist()
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
