"""Alignment of an estimated trajectory with the true one."""

from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxloc import _linalg
from jaxloc._linalg import matmul


class Alignment(eqx.Module):
    """Alignment of an estimated trajectory with the true one (strategy)."""

    @abstractmethod
    def align(
        self, points: Float[Array, "n 3"], targets: Float[Array, "n 3"], valid: Bool[Array, " n"]
    ) -> Float[Array, "n 3"]:
        """Moves points onto targets."""


class NoAlignment(Alignment):
    """Both paths are in the same frame already."""

    def align(
        self, points: Float[Array, "n 3"], targets: Float[Array, "n 3"], valid: Bool[Array, " n"]
    ) -> Float[Array, "n 3"]:
        """Leaves points where they are."""
        return points


class RigidAlignment(Alignment):
    """The rotation and translation with the least sum of squared distances.

    References:
        Umeyama, "Least-squares estimation of transformation parameters between two point patterns", PAMI 1991.
    """

    def align(
        self, points: Float[Array, "n 3"], targets: Float[Array, "n 3"], valid: Bool[Array, " n"]
    ) -> Float[Array, "n 3"]:
        """Moves points rigidly."""
        return _umeyama(points, targets, valid, with_scale=False)


class SimilarityAlignment(Alignment):
    """The rotation, translation and scale with the least sum of squared distances: for monocular paths.

    References:
        Umeyama, "Least-squares estimation of transformation parameters between two point patterns", PAMI 1991.
    """

    def align(
        self, points: Float[Array, "n 3"], targets: Float[Array, "n 3"], valid: Bool[Array, " n"]
    ) -> Float[Array, "n 3"]:
        """Moves and scales points."""
        return _umeyama(points, targets, valid, with_scale=True)


def _umeyama(
    points: Float[Array, "n 3"], targets: Float[Array, "n 3"], valid: Bool[Array, " n"], *, with_scale: bool
) -> Float[Array, "n 3"]:
    weights = valid.astype(points.dtype)[:, None] / jnp.maximum(jnp.sum(valid), 1).astype(points.dtype)
    center, target_center = jnp.sum(weights * points, axis=0), jnp.sum(weights * targets, axis=0)
    a, b = points - center[None], targets - target_center[None]
    # The alignment minimizes the sum of squares: its own change has no effect on it (envelope theorem), so the RMSE has
    # its exact gradient without that of the decomposition, which does not exist on a straight path.
    covariance = jax.lax.stop_gradient(matmul((weights * b).T, a))
    u, spectrum, vt = _linalg.svd(covariance)
    sign = jnp.where(jnp.linalg.det(u) * jnp.linalg.det(vt) < 0, -1.0, 1.0).astype(points.dtype)
    signs = jnp.ones(3, points.dtype).at[2].set(sign)
    rotation = matmul(u * signs[None], vt)
    variance = jax.lax.stop_gradient(jnp.sum(weights * a**2))
    scale = jnp.where(variance > 0, jnp.sum(spectrum * signs) / jnp.where(variance > 0, variance, 1.0), 1.0)
    scale = scale if with_scale else 1.0
    return scale * matmul(a, rotation.T) + target_center[None]
