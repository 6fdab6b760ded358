"""Gaussian mixtures with a fixed number of slots."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.special import logsumexp
from jaxtyping import Array, Bool, Float, Int

from jaxloc import _tree as tree
from jaxloc._jit import filter_jit
from jaxloc._linalg import matmul
from jaxloc.beliefs import validity
from jaxloc.beliefs.gaussian import Gaussian
from jaxloc.beliefs.square_root import cholesky
from jaxloc.poses import is_flat, local, retract, tangent_dimension

_MEAN_STEPS = 3
_ROUNDING = 1e-5  # of a covariance, relative to its largest eigenvalue


class Mixture(eqx.Module):
    """``D(x) = sum_i w_i N(x; m_i, P_i)``: a density when the weights sum to one, else an intensity.

    Empty slots have weight zero; their means and covariances are finite and have no meaning.

    Args:
        weights: w, never negative; of an intensity, their sum is an expected number of objects.
        means: m, vectors, poses, or any pytree of them, stacked along a leading axis.
        covariances: P, each in the tangent space of its mean.
        labels: integers that stay with the components, such as track numbers. Zeros by default.

    References:
        Vo and Ma, "The Gaussian mixture probability hypothesis density filter", IEEE TSP 2006 [T-45].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> two = jl.beliefs.Mixture(jnp.array([0.5, 1.0]), jnp.eye(2), jnp.stack([jnp.eye(2)] * 2))
        >>> float(two.mass), round(float(jnp.exp(two.log_intensity(jnp.zeros(2)))), 4)
        (1.5, 0.1448)
    """

    weights: Float[Array, " k"]
    means: Any
    covariances: Float[Array, "k d d"]
    labels: Int[Array, " k"]

    def __init__(self, weights: Any, means: Any, covariances: Any, labels: Any = None):
        self.weights, self.means, self.covariances = weights, means, covariances
        self.labels = jnp.zeros(weights.shape, jnp.int32) if labels is None else labels

    @staticmethod
    def empty(capacity: int, example: Any) -> "Mixture":
        """A mixture without components.

        Args:
            capacity: number of slots.
            example: a state, for its structure.
        """
        size = tangent_dimension(example)
        dtype = jnp.result_type(*[leaf for leaf in jax.tree.leaves(example) if eqx.is_inexact_array(leaf)])
        means = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (capacity, *leaf.shape)), example)
        covariances = jnp.broadcast_to(jnp.eye(size, dtype=dtype), (capacity, size, size))
        return Mixture(jnp.zeros(capacity, dtype), means, covariances)

    def check(self) -> "Mixture":
        """The mixture itself, after a check on the host; nothing is checked inside a transformation.

        Raises:
            ValueError: if a weight is negative, a value is not finite, or a covariance has a negative eigenvalue.
        """
        leaves = [leaf for leaf in jax.tree.leaves(self) if eqx.is_inexact_array(leaf)]
        if any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
            return self
        if not all(np.isfinite(leaf).all() for leaf in leaves):
            raise ValueError("A mixture holds non-finite values.")
        if (np.asarray(self.weights) < 0.0).any():
            raise ValueError(f"Weights of a mixture are never negative; got {np.asarray(self.weights).min():.3g}.")
        values = np.linalg.eigvalsh(np.asarray(self.covariances, np.float64))
        negative = values.min(axis=-1, initial=np.inf) < -_ROUNDING * np.abs(values).max(axis=-1, initial=0.0)
        if negative.any():
            place = int(np.argmax(negative))
            raise ValueError(f"Covariance {place} of a mixture has the negative eigenvalue {values[place].min():.3g}.")
        return self

    def usable(self) -> "Mixture":
        """The mixture without components that hold non-finite numbers or numbers that overflow: their slots are empty.

        Example:
            >>> import jax.numpy as jnp, jaxloc as jl
            >>> means = jnp.array([[0.0], [jnp.nan], [2.0]])
            >>> mixture = jl.beliefs.Mixture(jnp.array([1.0, 1.0, jnp.inf]), means, jnp.ones((3, 1, 1)))
            >>> mixture.usable().weights.tolist(), mixture.usable().means[:, 0].tolist()
            ([1.0, 0.0, 0.0], [0.0, 0.0, 0.0])
        """
        scales = jnp.sqrt(jnp.abs(lax.stop_gradient(self.covariances)))
        good = tree.slots_within_range((self.weights, self.means, scales))
        size = self.covariances.shape[-1]
        eye = jnp.broadcast_to(jnp.eye(size, dtype=self.covariances.dtype), self.covariances.shape)
        empty = Mixture(jnp.zeros_like(self.weights), validity.neutral(self.means), eye, self.labels)
        return jax.vmap(tree.where)(good, self, empty)

    @property
    def capacity(self) -> int:
        """Number of slots."""
        return self.weights.shape[0]

    @property
    def valid(self) -> Bool[Array, " k"]:
        """Which slots hold a component."""
        return self.weights > 0.0

    @property
    def mass(self) -> Float[Array, ""]:
        """Sum of the weights."""
        return jnp.sum(self.weights)

    def take(self, indices: Int[Array, " n"]) -> "Mixture":
        """Some of the components, by index."""
        return jax.tree.map(lambda leaf: leaf[indices], self)

    def concatenate(self, other: "Mixture") -> "Mixture":
        """The sum of two mixtures: the components of both."""
        return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), self, other)

    def padded(self, capacity: int) -> "Mixture":
        """The mixture with empty slots added, up to a capacity."""
        more = self.take(jnp.zeros(max(capacity - self.capacity, 0), jnp.int32))
        return self.concatenate(more.scaled(0.0))

    def scaled(self, factor: Any) -> "Mixture":
        """The mixture with weights scaled by a number, or by one for each component."""
        return Mixture(self.weights * factor, self.means, self.covariances, self.labels)

    @filter_jit
    def log_intensity(self, x: Any) -> Float[Array, ""]:
        """``log D(x)``, with respect to volume in the tangent spaces; a log density when the weights sum to one."""
        log_prob = jax.vmap(lambda mean, covariance: Gaussian(mean, covariance).log_prob(x))
        terms = log_prob(self.means, self.covariances)
        weights = jnp.where(self.valid, self.weights, 1.0)
        return logsumexp(jnp.where(self.valid, jnp.log(weights) + terms, -jnp.inf))

    @filter_jit
    def gaussian(self) -> Gaussian:
        """The normal density with the mean and covariance of the mixture, normalized by its mass."""
        best = jnp.argmax(self.weights)
        center = jax.tree.map(lambda leaf: leaf[best], self.means)
        total = jnp.where(self.mass > 0.0, self.mass, 1.0)
        shares = jnp.where(self.mass > 0.0, self.weights / total, 1.0 / self.capacity)
        for _ in range(1 if is_flat(center) else _MEAN_STEPS):
            base = center
            shift = matmul(shares, jax.vmap(lambda mean, base=base: local(base, mean))(self.means))
            center = retract(center, shift)
        deviations = jax.vmap(lambda mean: local(center, mean))(self.means)
        within = jnp.sum(shares[:, None, None] * self.covariances, axis=0)
        return Gaussian(center, within + matmul(deviations.T, shares[:, None] * deviations))

    def roots(self) -> Float[Array, "k d d"]:
        """Lower triangular roots of the covariances."""
        return jax.vmap(cholesky)(self.covariances)
