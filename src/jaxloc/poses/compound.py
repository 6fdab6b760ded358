"""Jacobians of compound planar poses in their parameters (x, y, theta), after Kelly.

They differ from the tangents of the rest of jaxloc: a perturbation here is added to x, y and theta. Of
the compound ``c = a @ b`` the left Jacobian is ``dc/da``, the right one ``dc/db``; the inverse Jacobian is that of
``a^-1``.

References:
    Kelly, Mobile Robotics, 2013, section 2.7; used in his section 9.2 for mosaics and fiducials [K-4, K-85].
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxloc._arguments import checked
from jaxloc._jit import filter_jit
from jaxloc._linalg import matmul
from jaxloc.poses.se2 import SE2


def _rows(*rows: tuple[Array, ...]) -> Array:
    return jnp.stack([jnp.stack(row) for row in rows])


@filter_jit
@checked
def left_jacobian(a: SE2, b: SE2) -> Float[Array, "3 3"]:
    """Derivative of the compound's (x, y, theta) with respect to those of its left factor.

    Args:
        a: pose T_i_j.
        b: pose T_j_k.

    Returns:
        ``[[1, 0, -(y_c - y_a)], [0, 1, x_c - x_a], [0, 0, 1]]`` of ``c = a @ b``.

    Example:
        >>> import jaxloc as jl
        >>> a, b = jl.poses.SE2(1.0, 0.0, 0.0), jl.poses.SE2(2.0, 3.0, 0.5)
        >>> jl.poses.compound.left_jacobian(a, b).tolist()
        [[1.0, 0.0, -3.0], [0.0, 1.0, 2.0], [0.0, 0.0, 1.0]]
    """
    offset = matmul(a.rotation.matrix(), b.translation)
    zero, one = jnp.zeros_like(a.x), jnp.ones_like(a.x)
    return _rows((one, zero, -offset[1]), (zero, one, offset[0]), (zero, zero, one))


@filter_jit
@checked
def right_jacobian(a: SE2, b: SE2) -> Float[Array, "3 3"]:
    """Derivative of the compound's (x, y, theta) with respect to those of its right factor.

    Args:
        a: pose T_i_j.
        b: pose T_j_k (its value has no influence).

    Returns:
        The rotation of ``a``, bordered by one.

    Example:
        >>> import jaxloc as jl
        >>> a, b = jl.poses.SE2(1.0, 2.0, 0.5), jl.poses.SE2(0.0, 0.0, 0.0)
        >>> bool((jl.poses.compound.right_jacobian(a, b)[:2, :2] == a.rotation.matrix()).all())
        True
    """
    del b
    c, s = a.rotation.cos, a.rotation.sin
    zero, one = jnp.zeros_like(c), jnp.ones_like(c)
    return _rows((c, -s, zero), (s, c, zero), (zero, zero, one))


@filter_jit
@checked
def inverse_jacobian(a: SE2) -> Float[Array, "3 3"]:
    """Derivative of the inverse pose's (x, y, theta) with respect to those of the pose.

    Args:
        a: pose T_i_j.

    Returns:
        ``[[-c, -s, y'], [s, -c, -x'], [0, 0, -1]]`` with (x', y') the position of ``a^-1``.

    Example:
        >>> import jaxloc as jl
        >>> jl.poses.compound.inverse_jacobian(jl.poses.SE2(2.0, 3.0, 0.0))[:, 2].tolist()
        [-3.0, 2.0, -1.0]
    """
    c, s = a.rotation.cos, a.rotation.sin
    x, y = a.inverse().translation
    zero, one = jnp.zeros_like(c), jnp.ones_like(c)
    return _rows((-c, -s, y), (s, -c, -x), (zero, zero, -one))
