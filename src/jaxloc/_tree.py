"""Selection and masking of whole pytrees."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool


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
