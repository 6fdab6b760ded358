"""Validity of densities: which are usable, and finite densities that stand in for those that are not."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxloc import _tree as tree
from jaxloc._linalg import matmul
from jaxloc.beliefs.square_root import cholesky
from jaxloc.poses import Direction
from jaxloc.poses.lie_group import Group


def neutral(value: Any) -> Any:
    """Identities and zeros in place of the poses and floating-point arrays of a pytree, stacked ones too.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> place, speed = neutral((jl.poses.SE2(1.0, 2.0, 3.0), jnp.array([jnp.nan])))
        >>> float(place.theta), speed.tolist()
        (0.0, [0.0])
    """

    def replace(node):
        if isinstance(node, Direction):
            return Direction(jnp.zeros_like(node.vector).at[..., 2].set(1.0))
        if isinstance(node, Group):
            one = type(node).identity(jax.tree.leaves(node)[0].dtype)
            return jax.tree.map(lambda like, leaf: jnp.broadcast_to(leaf, like.shape), node, one)
        return jnp.zeros_like(node) if eqx.is_inexact_array(node) else node

    return jax.tree.map(replace, value, is_leaf=lambda node: isinstance(node, Group | Direction))


def finite_or_neutral(value: Any) -> Any:
    """The pytree with zero in place of non-finite numbers, and the identity in place of poses that hold one.

    Python numbers become arrays, weakly typed.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> pose, speed = finite_or_neutral((jl.poses.SE2(1.0, 2.0, jnp.nan), jnp.array([jnp.nan, 1.0])))
        >>> float(pose.x), float(pose.theta), speed.tolist()
        (0.0, 0.0, [0.0, 1.0])
    """

    def replace(node):
        if not isinstance(node, Group | Direction):
            return tree.finite_or_zero(jnp.asarray(node))
        depth = len(node.batch_shape)
        good = [jnp.all(jnp.isfinite(leaf), axis=tuple(range(depth, leaf.ndim))) for leaf in jax.tree.leaves(node)]
        good = jnp.all(jnp.stack(good), axis=0)

        def choose(leaf, other):
            return jnp.where(good.reshape(*good.shape, *(1,) * (leaf.ndim - depth)), leaf, other)

        return jax.tree.map(choose, node, neutral(node))

    return jax.tree.map(replace, value, is_leaf=lambda node: isinstance(node, Group | Direction))


def is_covariance(matrix: Float[Array, "d d"]) -> Bool[Array, ""]:
    """Whether a matrix is finite, within range, and positive semidefinite up to rounding; without derivatives.

    Example:
        >>> import jax.numpy as jnp
        >>> [bool(is_covariance(jnp.diag(jnp.array([1.0, x])))) for x in (4.0, 0.0, -1.0, jnp.nan)]
        [True, True, False, False]
    """
    fine = tree.within_range(jnp.sqrt(jnp.abs(lax.stop_gradient(matrix))))
    safe = jnp.where(fine, lax.stop_gradient(matrix), jnp.eye(matrix.shape[0], dtype=matrix.dtype))
    return fine & factors(cholesky(safe), safe)


def factors(root: Float[Array, "d d"], covariance: Float[Array, "d d"]) -> Bool[Array, ""]:
    """Whether `cholesky` found the root of a covariance, rather than that of a definite matrix near it.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> indefinite = jnp.array([[1.0, 2.0], [2.0, 1.0]])
        >>> bool(factors(jl.beliefs.square_root.cholesky(indefinite), indefinite))
        False
    """
    info, size = jnp.finfo(covariance.dtype), covariance.shape[0]
    root, covariance = lax.stop_gradient((root, covariance))
    scale = jnp.sqrt(jnp.maximum(jnp.diagonal(covariance), float(info.tiny) ** 0.5))
    missed = jnp.tril(matmul(root, root.T) - covariance) / scale[:, None] / scale[None, :]
    # Beside a pivot of rounding size, entries of the root of that size are dropped.
    return jnp.all(jnp.abs(missed) <= 4.0 * (size * float(info.eps)) ** 0.5)


def usable(mean: Any, covariance: Float[Array, "d d"]) -> Bool[Array, ""]:
    """Whether mean and covariance are those of a density.

    Example:
        >>> import jax.numpy as jnp
        >>> bool(usable(jnp.zeros(1), jnp.eye(1))), bool(usable(jnp.array([jnp.inf]), jnp.eye(1)))
        (True, False)
    """
    return tree.within_range(mean) & is_covariance(covariance)


def unknown(mean: Any, covariance: Float[Array, "d d"]) -> tuple[Any, Float[Array, "d d"]]:
    """Mean and covariance of "nothing is known": a neutral mean, and standard deviations at the end of the range.

    Filters start from it where a prior is not usable, and report ``ok=False`` for states beyond the range.

    Example:
        >>> import jax.numpy as jnp
        >>> mean, covariance = unknown(jnp.array([jnp.nan]), jnp.eye(1))
        >>> mean.tolist(), f"{covariance.item():.0e}"
        ([0.0], '2e+19')
    """
    size, dtype = covariance.shape[-1], covariance.dtype
    return neutral(mean), jnp.eye(size, dtype=dtype) * jnp.asarray(1.01 * tree.largest(dtype) ** 2, dtype)


def usable_or_unknown(mean: Any, covariance: Float[Array, "d d"]) -> tuple[Any, Float[Array, "d d"]]:
    """Mean and covariance of a density where they are usable, else `unknown`.

    Example:
        >>> import jax.numpy as jnp
        >>> mean, covariance = usable_or_unknown(jnp.array([2.0]), jnp.eye(1))
        >>> mean.tolist(), covariance.tolist()
        ([2.0], [[1.0]])
    """
    return tree.where(usable(mean, covariance), (mean, covariance), unknown(mean, covariance))


def positive(sigma: Array) -> Bool[Array, "..."]:
    """Which standard deviations can be used: positive, finite, and with a finite square of their inverse.

    Example:
        >>> positive(jnp.array([0.5, 0.0, -1.0, jnp.nan, jnp.inf])).tolist()
        [True, False, False, False, False]
    """
    sigma = lax.stop_gradient(sigma)
    return jnp.isfinite(sigma) & (sigma > float(jnp.finfo(sigma.dtype).max) ** -0.5)
