"""Retraction and local coordinates of any pytree: poses and directions on their manifolds, arrays by addition."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxloc._arguments import checked
from jaxloc.poses.direction import Direction
from jaxloc.poses.lie_group import Group


def _is_manifold(node: Any) -> bool:
    return isinstance(node, Group | Direction)


def _moves(node: Any) -> bool:
    return _is_manifold(node) or eqx.is_inexact_array(node)


def _dimension(node: Any) -> int:
    if _is_manifold(node):
        count = node.dof
        for size in node.batch_shape:
            count *= size
        return count
    return node.size


def _leaves(value: Any) -> list[Any]:
    return [node for node in jax.tree.leaves(value, is_leaf=_is_manifold) if _moves(node)]


def tangent_dimension(value: Any) -> int:
    """Length of the flat tangent vector of a pytree; poses count their degrees of freedom, other floats one each.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> jl.poses.tangent_dimension({"pose": jl.poses.SE3.identity(), "velocity": jnp.zeros(3)})
        9
    """
    return sum(_dimension(node) for node in _leaves(value))


def tangent_labels(value: Any) -> tuple[str, ...]:
    """Name of each entry of the tangent vector, in order: the path in the pytree and the direction.

    Covariances of a state or measurement have this order. (JAX sorts the entries of a dict by key.)

    Example:
        >>> import jaxloc as jl
        >>> jl.poses.tangent_labels(jl.poses.SE2(0.0, 0.0, 0.0))
        ('x', 'y', 'rotation')
    """
    names: list[str] = []
    for path, node in jax.tree.leaves_with_path(value, is_leaf=_is_manifold):
        if not _moves(node):
            continue
        prefix = jax.tree_util.keystr(path, simple=True, separator=".")
        inner = node.labels if _is_manifold(node) else ()
        count = _dimension(node) // max(len(inner), 1)
        for i in range(count):
            suffix = f"[{i}]" if count > 1 else ""
            base = prefix + suffix
            names += [f"{base}.{label}".lstrip(".") for label in inner] or [base or "value"]
    return tuple(names)


def _over_stack(function: Any, depth: int) -> Any:
    for _ in range(depth):
        function = jax.vmap(function)
    return function


@checked
def retract(value: Any, delta: Float[Array, " d"]) -> Any:
    """The value moved along a tangent: ``T @ exp(d)`` for poses (also stacked ones), a sum for arrays.

    Args:
        value: any pytree; leaves that are neither poses nor floating-point arrays are unchanged.
        delta: flat tangent in the order of the leaves; a pose takes (translation, rotation).

    Returns:
        The moved pytree.

    Raises:
        ValueError: the length of the tangent is not `tangent_dimension`.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> moved = jl.poses.retract((jl.poses.SE2(0.0, 0.0, 0.0), jnp.ones(2)), jnp.arange(5.0))
        >>> moved[1].tolist()
        [4.0, 5.0]
    """
    needed = tangent_dimension(value)
    if delta.shape[0] != needed:
        raise ValueError(f"The tangent has {delta.shape[0]} entries, but this value has {needed} degrees of freedom.")
    nodes, structure = jax.tree.flatten(value, is_leaf=_is_manifold)
    start, moved = 0, []
    for node in nodes:
        if not _moves(node):
            moved.append(node)
            continue
        part = delta[start : start + _dimension(node)]
        start += _dimension(node)
        if _is_manifold(node):
            part = part.reshape(*node.batch_shape, node.dof)
            moved.append(_over_stack(lambda pose, d: pose.retract(d), len(node.batch_shape))(node, part))
        else:
            moved.append(node + part.reshape(node.shape))
    return jax.tree.unflatten(structure, moved)


def local(value: Any, other: Any) -> Float[Array, " d"]:
    """The tangent from one pytree to another: the inverse of `retract`.

    Args:
        value: base of the tangent.
        other: a pytree of the same structure.

    Returns:
        Flat tangent; for poses ``log(T^-1 @ other)``.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> jl.poses.local(jl.poses.SE2(0.0, 0.0, 0.0), jl.poses.SE2(1.0, 0.0, 0.0)).tolist()
        [1.0, 0.0, 0.0]
    """
    parts = []
    for a, b in zip(_leaves(value), _leaves(other), strict=True):
        if _is_manifold(a):
            parts.append(_over_stack(lambda pose, o: pose.local(o), len(a.batch_shape))(a, b).reshape(-1))
        else:
            parts.append((b - a).reshape(-1))
    if not parts:
        raise ValueError("The value holds neither poses nor floating-point arrays: it has no tangent.")
    return jnp.concatenate(parts)


def is_flat(value: Any) -> bool:
    """Whether a pytree holds no poses or directions, so that all its tangent spaces coincide.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> jl.poses.is_flat(jnp.zeros(3)), jl.poses.is_flat(jl.poses.SE2(0.0, 0.0, 0.0))
        (True, False)
    """
    return not any(_is_manifold(node) for node in _leaves(value))


@checked
def carry(value: Any, delta: Float[Array, " d"], target: Any) -> Float[Array, "d d"]:
    """Derivative of ``local(target, retract(value, delta + e))`` by e: transports tangents and covariances.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> jl.poses.carry(jnp.zeros(2), jnp.ones(2), jnp.ones(2)).tolist()
        [[1.0, 0.0], [0.0, 1.0]]
    """
    return jax.jacfwd(lambda e: local(target, retract(value, delta + e)))(jnp.zeros_like(delta))
