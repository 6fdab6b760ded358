"""Normal densities on vectors, poses and any pytree of them."""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from jaxloc import _tree as tree
from jaxloc._jit import filter_jit
from jaxloc._linalg import matmul
from jaxloc.beliefs import validity
from jaxloc.beliefs.square_root import cholesky, solve, whiten
from jaxloc.poses import local, retract, tangent_dimension


class Gaussian(eqx.Module):
    """A normal density ``x = retract(mean, d)`` with ``d ~ N(0, covariance)``.

    Args:
        mean: a vector, a pose (`SE2`, `SE3`, ...), or any pytree of floating arrays and poses.
        covariance: "d d" in the tangent space of the mean (right perturbation; a pose takes translation, rotation).

    Raises:
        ValueError: if the covariance does not fit the tangent space of the mean.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> belief = jl.beliefs.Gaussian(jl.poses.SE2(1.0, 2.0, 0.3), 0.01 * jnp.eye(3))
        >>> float(belief.mahalanobis_squared(jl.poses.SE2(1.0, 2.0, 0.4)).round(3))
        1.0
    """

    mean: Any
    covariance: Float[Array, "d d"]

    def __check_init__(self):
        if not isinstance(self.covariance, jax.Array) or self.covariance.ndim != 2:
            return  # a stack, or a prefix tree such as in_axes
        size = tangent_dimension(self.mean)
        if self.covariance.shape != (size, size):
            raise ValueError(
                f"Gaussian got a covariance of shape {self.covariance.shape} for a mean with {size} degrees of "
                f"freedom; give ({size}, {size})."
            )

    @property
    def dimension(self) -> int:
        """Number of degrees of freedom of one density."""
        return self.covariance.shape[-1]

    @filter_jit
    def mahalanobis_squared(self, x: Any) -> Float[Array, ""]:
        """Squared distance ``d^T P^-1 d``, ``d = local(mean, x)``: chi-square with `dimension` degrees of freedom."""
        return jnp.sum(whiten(cholesky(self.covariance), local(self.mean, x)) ** 2)

    @filter_jit
    def log_prob(self, x: Any) -> Float[Array, ""]:
        """Log density at x with respect to volume in the tangent space of the mean.

        Args:
            x: a value of the same structure as the mean.
        """
        root = cholesky(self.covariance)
        distance = jnp.sum(whiten(root, local(self.mean, x)) ** 2)
        log_volume = jnp.sum(jnp.log(jnp.diagonal(root)))
        return -0.5 * distance - log_volume - 0.5 * self.dimension * math.log(2.0 * math.pi)

    @filter_jit
    def sample(self, num_samples: int, *, key: Key[Array, ""]) -> Any:
        """Random samples, stacked along a leading axis."""
        normal = jax.random.normal(key, (num_samples, self.dimension), self.covariance.dtype)
        deltas = matmul(normal, cholesky(self.covariance).T)
        return jax.vmap(lambda delta: retract(self.mean, delta))(deltas)

    def marginal(self, indices: tuple[int, ...]) -> "Gaussian":
        """Marginal density of some entries of a vector."""
        _require_vector(self, "marginal")
        chosen = jnp.array(indices)
        return Gaussian(self.mean[chosen], self.covariance[chosen[:, None], chosen[None, :]])


@filter_jit
def fuse(a: Gaussian, b: Gaussian) -> Gaussian:
    """Information fusion: the normalized product of two densities of one vector.

    Computed as ``m = m_a + K (m_b - m_a)`` with ``K = P_a (P_a + P_b)^-1`` and the Joseph form, which needs no inverse
    of either covariance and keeps the result positive semidefinite. A density that is none (with a non-finite number or
    an indefinite covariance) has no weight: the result is the other one, or `validity.unknown` where both are none.

    Args:
        a: density with a vector mean "d".
        b: independent density of the same vector.

    Returns:
        Density with ``P^-1 = P_a^-1 + P_b^-1`` and ``P^-1 m = P_a^-1 m_a + P_b^-1 m_b``.

    Raises:
        ValueError: if a mean is not a vector.

    References:
        Thesis Fig. 1.1 [T-2]; Bar-Shalom, Li, Kirubarajan, *Estimation with Applications*, 2001, section 3.2.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> a = jl.beliefs.Gaussian(jnp.array([0.0]), jnp.array([[1.0]]))
        >>> b = jl.beliefs.Gaussian(jnp.array([3.0]), jnp.array([[0.5]]))
        >>> jl.beliefs.fuse(a, b).mean.round(4).tolist()
        [2.0]
    """
    _require_vector(a, "fuse")
    _require_vector(b, "fuse")
    pairs = (a.mean, a.covariance), (b.mean, b.covariance)
    good = [validity.usable(*pair) for pair in pairs]
    safe = [tree.where(fine, pair, validity.unknown(*pair)) for fine, pair in zip(good, pairs, strict=True)]
    _, both = tree.protect(_product, *safe)
    return Gaussian(*tree.where(good[0] & good[1], both, tree.where(good[0], safe[0], safe[1])))


def _product(one: tuple[Array, Array], other: tuple[Array, Array]) -> tuple[Array, tuple[Array, Array]]:
    """Mean and covariance of the product of two densities, and whether they are finite."""
    a, b = Gaussian(*one), Gaussian(*other)
    gain = solve(cholesky(a.covariance + b.covariance), a.covariance).T
    rest = jnp.eye(a.dimension, dtype=gain.dtype) - gain
    covariance = matmul(matmul(rest, a.covariance), rest.T) + matmul(matmul(gain, b.covariance), gain.T)
    fused = a.mean + matmul(gain, b.mean - a.mean), covariance
    return tree.all_finite(fused), fused


def _require_vector(gaussian: Gaussian, verb: str) -> None:
    if not (isinstance(gaussian.mean, jax.Array) and gaussian.mean.ndim == 1):
        raise ValueError(f"{verb} needs a Gaussian with a vector mean; it got {type(gaussian.mean).__name__}.")
