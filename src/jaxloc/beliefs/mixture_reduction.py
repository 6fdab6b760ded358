"""Gaussian mixture reduction: pruning, merging of close components, and a cap on their number.

Components are sorted by weight. The heaviest absorbs all that are close to it, then the heaviest of the rest, and so
on. This greedy clustering is found for all components at once, in as many rounds as cluster centers depend on each
other (a handful), each a product of a vector with the matrix of close pairs: there is no loop over components, so that
the reduction is fast under `jax.vmap`.
"""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxloc._jit import filter_jit
from jaxloc._linalg import matmul
from jaxloc.beliefs.mixture import Mixture
from jaxloc.beliefs.square_root import whiten
from jaxloc.poses import carry, is_flat, local, retract


class Closeness(eqx.Module):
    """Distance for merging: a component is absorbed by a heavier one at most the threshold away."""

    threshold: eqx.AbstractVar[float | Float[Array, ""]]

    @abstractmethod
    def distances(self, mixture: Mixture) -> Float[Array, "k k"]:
        """Distance of each component (column) to each that may absorb it (row)."""


class MahalanobisDistance(Closeness):
    """``(m_i - m_j)^T P_i^-1 (m_i - m_j)`` of component i to cluster center j.

    References:
        Vo and Ma 2006, table II [T-83], [T-84].
    """

    threshold: float | Float[Array, ""] = 4.0

    def distances(self, mixture: Mixture) -> Float[Array, "k k"]:
        """In the covariance of the component that would be absorbed."""
        return _mahalanobis(mixture.means, mixture.roots())


class KullbackLeibler(Closeness):
    """``KL(N_i || N_j) = (tr P_j^-1 P_i + d^T P_j^-1 d - n + log |P_j| / |P_i|) / 2`` of component i to center j.

    References:
        Runnalls, "Kullback-Leibler approach to Gaussian mixture reduction", IEEE TAES 2007 [T-83], [T-92].
    """

    threshold: float | Float[Array, ""] = 1.0

    def distances(self, mixture: Mixture) -> Float[Array, "k k"]:
        """Information loss in nats when the cluster center replaces the component."""
        roots = mixture.roots()
        size = roots.shape[-1]
        squared = _mahalanobis(mixture.means, roots).T
        volumes = jnp.sum(jnp.log(jnp.diagonal(roots, axis1=-2, axis2=-1)), axis=-1)
        eye = jnp.eye(size, dtype=roots.dtype)
        inverse = jax.vmap(lambda root: whiten(root, eye))(roots)
        precisions = matmul(inverse.mT, inverse)
        traces = matmul(precisions.reshape(-1, size * size), mixture.covariances.reshape(-1, size * size).T)
        return 0.5 * (traces + squared - size) + volumes[:, None] - volumes[None, :]


class Reduced(eqx.Module):
    """A reduced mixture.

    Attributes:
        mixture: with the requested number of slots, heaviest first; labels are those of the cluster centers.
        lost: weight that was pruned or dropped for lack of slots.
        crowded: number of components above the pruning threshold that were dropped for lack of slots.
    """

    mixture: Mixture
    lost: Float[Array, ""]
    crowded: Int[Array, ""]


@filter_jit
def reduce_mixture(
    mixture: Mixture,
    capacity: int,
    *,
    prune: float = 1e-5,
    closeness: Closeness = MahalanobisDistance(),  # noqa: B008 (a record that never changes)
    candidates: int | None = None,
) -> Reduced:
    """Prunes light components, merges close ones, keeps the heaviest.

    Merging matches moments (the dispersion of the means included), so that mass, mean and covariance are kept.

    Args:
        mixture: any number of components; those with non-finite numbers count as absent.
        capacity: slots of the result.
        prune: weights below it are dropped.
        closeness: which components are merged.
        candidates: largest number of components that take part in merging, the heaviest; None for all.

    Returns:
        The mixture, and its loss.

    References:
        Vo and Ma 2006, table II [T-83].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> means = jnp.array([[0.0], [0.1], [9.0]])
        >>> many = jl.beliefs.Mixture(jnp.array([0.6, 0.4, 0.5]), means, jnp.ones((3, 1, 1)))
        >>> jl.beliefs.mixture_reduction.reduce_mixture(many, 2).mixture.weights.round(3).tolist()
        [1.0, 0.5]
    """
    mixture = mixture.usable()
    num = min(mixture.capacity, mixture.capacity if candidates is None else candidates)
    heavy = mixture.valid & (mixture.weights >= jnp.asarray(prune, mixture.weights.dtype))
    weights, order = lax.top_k(jnp.where(heavy, mixture.weights, 0.0), num)
    chosen = mixture.take(order)
    chosen = Mixture(weights, chosen.means, chosen.covariances, chosen.labels)
    close = closeness.distances(_without_gradient(chosen)) <= lax.stop_gradient(closeness.threshold)
    merged = _merge(chosen, _owners(close, chosen.valid))
    weights, order = lax.top_k(merged.weights, min(capacity, num))
    kept = merged.take(order).padded(capacity)
    crowded = jnp.sum(heavy) - jnp.sum(chosen.valid) + jnp.sum(merged.valid) - jnp.sum(kept.valid)
    return Reduced(kept, mixture.mass - kept.mass, crowded)


def _without_gradient(mixture: Mixture) -> Mixture:
    return jax.tree.map(lax.stop_gradient, mixture)


def _mahalanobis(means: Any, roots: Float[Array, "k d d"]) -> Float[Array, "k k"]:
    """Squared distance of component i to j at [j, i], in the covariance of i."""
    first = jax.tree.map(lambda leaf: leaf[0], means)
    if not is_flat(first):
        return jax.vmap(lambda center: _to_one(means, roots, center))(means)
    # Forward substitution for all pairs at once, which compiles to a single pass over contiguous memory.
    points = jax.vmap(lambda mean: local(first, mean))(means)
    total, whitened = jnp.zeros((len(roots), len(roots)), roots.dtype), []
    for i in range(roots.shape[-1]):
        rest = points[None, :, i] - points[:, None, i]
        for j, other in enumerate(whitened):
            rest = rest - roots[None, :, i, j] * other
        whitened.append(rest * (1.0 / roots[:, i, i])[None, :])
        total = total + whitened[-1] ** 2
    return total


def _to_one(means: Any, roots: Float[Array, "k d d"], center: Any) -> Float[Array, " k"]:
    deltas = jax.vmap(lambda mean: local(mean, center))(means)
    return jnp.sum(jax.vmap(whiten)(roots, deltas) ** 2, axis=-1)


def _owners(close: Bool[Array, "k k"], valid: Bool[Array, " k"]) -> Int[Array, " k"]:
    """Cluster center of each component of a sorted mixture."""
    num = valid.shape[0]
    earlier = jnp.triu(jnp.ones((num, num), bool), 1)
    reach = close & earlier & valid[:, None]

    def advance(state):
        free, centers = state
        blocked = jnp.any(reach & free[:, None], axis=0)
        taken = jnp.any(reach & centers[:, None], axis=0)
        new = free & ~blocked & ~taken
        return free & ~taken & ~new, centers | new

    _, centers = lax.while_loop(lambda state: jnp.any(state[0]), advance, (valid, jnp.zeros_like(valid)))
    own = jnp.eye(num, dtype=bool) & valid[:, None]
    return jnp.argmax((reach | own) & centers[:, None], axis=0)


def _merge(mixture: Mixture, owners: Int[Array, " k"]) -> Mixture:
    """Moments of each cluster, in the slot of its center."""
    num, size = mixture.capacity, mixture.covariances.shape[-1]
    centers = jax.tree.map(lambda leaf: leaf[owners], mixture.means)
    shifts = jax.vmap(local)(centers, mixture.means)
    covariances = mixture.covariances
    flat = is_flat(jax.tree.map(lambda leaf: leaf[0], mixture.means))
    if not flat:
        covariances = _transported(mixture.means, jnp.zeros((num, size), covariances.dtype), centers, covariances)
    covariances = covariances + shifts[:, :, None] * shifts[:, None, :]
    moments = jnp.concatenate([shifts, covariances.reshape(num, -1)], axis=1) * mixture.weights[:, None]
    share = (owners[None, :] == jnp.arange(num)[:, None]) & mixture.valid[None, :]
    share = share.astype(covariances.dtype)
    weights = matmul(share, mixture.weights)
    nonempty = weights > 0.0
    sums = matmul(share, moments) / jnp.where(nonempty, weights, 1.0)[:, None]
    shift = sums[:, :size]
    covariances = sums[:, size:].reshape(num, size, size) - shift[:, :, None] * shift[:, None, :]
    covariances = jnp.where(nonempty[:, None, None], covariances, mixture.covariances)
    means = jax.vmap(retract)(mixture.means, shift)
    covariances = covariances if flat else _transported(mixture.means, shift, means, covariances)
    return Mixture(weights, means, covariances, mixture.labels)


def _transported(
    means: Any, deltas: Float[Array, "k d"], targets: Any, covariances: Float[Array, "k d d"]
) -> Float[Array, "k d d"]:
    """Covariances in the tangent spaces of the targets."""
    turns = jax.vmap(carry)(means, deltas, targets)
    return matmul(matmul(turns, covariances), turns.mT)
