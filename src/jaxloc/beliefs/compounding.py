"""Compounding of uncertain poses: composition, inverse and relative pose, with covariances."""

from typing import Any

from jaxtyping import Array

from jaxloc._jit import filter_jit
from jaxloc._linalg import matmul
from jaxloc.beliefs.gaussian import Gaussian
from jaxloc.poses.lie_group import Group


@filter_jit
def compose(a: Gaussian, b: Gaussian) -> Gaussian:
    """Density of ``T_a_b @ T_b_c`` for independent factors, to first order.

    ``P = Ad(B^-1) P_a Ad(B^-1)^T + P_b``: right perturbations of the first factor are transported through the second.

    Args:
        a: density of ``T_a_b`` (mean `SE2`, `SE3`, ...).
        b: density of ``T_b_c``.

    Returns:
        Density of ``T_a_c``.

    Raises:
        ValueError: if a mean is not a pose.

    References:
        Smith, Self, Cheeseman, "Estimating uncertain spatial relationships in robotics", 1990; Barfoot and Furgale,
        T-RO 2014, eq. 43 [K-4].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> step = jl.beliefs.Gaussian(jl.poses.SE2(1.0, 0.0, 0.0), jnp.diag(jnp.array([0.0, 0.0, 0.01])))
        >>> two = jl.beliefs.compose(step, step)
        >>> round(float(two.covariance[1, 1]), 4)  # the first heading error moved the end sideways
        0.01
    """
    _require_pose(a, b)
    return Gaussian(a.mean @ b.mean, _transported(b.mean.inverse(), a.covariance) + b.covariance)


@filter_jit
def invert(a: Gaussian) -> Gaussian:
    """Density of the inverse pose: ``P' = Ad(A) P Ad(A)^T``, exact in the tangent space.

    Args:
        a: density of ``T_a_b``.

    Returns:
        Density of ``T_b_a``.

    Raises:
        ValueError: if the mean is not a pose.

    References:
        Smith, Self, Cheeseman 1990, the "reversal" of a relation [K-4].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> pose = jl.beliefs.Gaussian(jl.poses.SE2(1.0, 2.0, 0.5), jnp.diag(jnp.array([1.0, 2.0, 3.0])))
        >>> bool(jnp.allclose(jl.beliefs.invert(jl.beliefs.invert(pose)).covariance, pose.covariance, atol=1e-4))
        True
    """
    _require_pose(a)
    return Gaussian(a.mean.inverse(), _transported(a.mean, a.covariance))


@filter_jit
def relative(a: Gaussian, b: Gaussian) -> Gaussian:
    """Density of ``T_w_a^-1 @ T_w_b`` for independent poses in one frame, to first order.

    Args:
        a: density of ``T_w_a``.
        b: density of ``T_w_b``.

    Returns:
        Density of ``T_a_b``.

    Raises:
        ValueError: if a mean is not a pose.

    References:
        Smith, Self, Cheeseman 1990, the "tail to tail" relation [K-3], [K-4].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> pose = jl.beliefs.Gaussian(jl.poses.SE2(1.0, 2.0, 0.5), 0.01 * jnp.eye(3))
        >>> bool(jnp.allclose(jl.beliefs.relative(pose, pose).covariance, 0.02 * jnp.eye(3), atol=1e-6))
        True
    """
    return compose(invert(a), b)


def _transported(pose: Group, covariance: Array) -> Array:
    adjoint = pose.adjoint()
    return matmul(matmul(adjoint, covariance), adjoint.T)


def _require_pose(*gaussians: Any) -> None:
    for gaussian in gaussians:
        if not isinstance(gaussian.mean, Group):
            raise ValueError(f"compounding needs Gaussians of poses; it got a mean of {type(gaussian.mean).__name__}.")
