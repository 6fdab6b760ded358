"""Data association of one particle: by landmark number, by position gates, and by descriptor."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxloc.beliefs import gate
from jaxloc.beliefs.square_root import cholesky, whiten
from jaxloc.slam.fast_slam.landmark_filter import LIKELY, Landmarks


class Candidates(eqx.Module):
    """Candidate landmarks of a reading by descriptor or number, the same for all particles.

    Attributes:
        alike: which rows of the map it may be.
        log_ratios: log likelihood of how alike it is to each, 0 where it is the same.
        log_new: log density of a reading of a new landmark, in units of range (m) and bearing (rad).
        free: the row a new landmark enters: one that no particle uses, or -1 for the first that the particle does not
            use. The capacity of the map if there is none.
    """

    alike: Bool[Array, " k"]
    log_ratios: Float[Array, " k"]
    log_new: Float[Array, ""]
    free: Int[Array, ""]

    @staticmethod
    def anything(capacity: int, dtype: jnp.dtype) -> "Candidates":
        """Candidates of a reading without descriptor: every landmark; new if outside all gates."""
        none = jnp.full((), -jnp.inf, dtype)
        zeros = jnp.zeros(capacity, dtype)
        return Candidates(jnp.ones(capacity, bool), zeros, none, jnp.full((), -1, jnp.int32))


class Association(eqx.Module):
    """Association of a reading by one particle.

    Attributes:
        row: of its map; the capacity where a new landmark finds no room.
        near: whether the reading lies within the gate of that row.
        fresh: whether the landmark is a new one.
    """

    row: Int[Array, ""]
    near: Bool[Array, ""]
    fresh: Bool[Array, ""]


def associate(
    known: Landmarks,
    residuals: Float[Array, "k 2"],
    covariances: Float[Array, "k 2 2"],
    number: Int[Array, ""],
    candidates: Candidates,
) -> Association:
    """Associates a reading with a landmark of one particle's map.

    A number that is not negative is taken at its word. Otherwise the reading belongs to the row that maximizes::

        log N(residual_j; 0, S_j) + log_ratio_j

    among the candidates and whose gate the reading lies in, unless there is none or a new landmark is likelier.

    Args:
        known: the particle's map.
        residuals: (range, bearing) measured less expected of each row, m and rad.
        covariances: of the residuals.
        number: of the landmark, negative where it is not known.
        candidates: candidate landmarks of the reading.

    Returns:
        The association.

    References:
        Sim, Elinas, Griffin, Little, "Vision-based SLAM using the Rao-Blackwellised particle filter", 2005; Thrun,
        Burgard, Fox, *Probabilistic Robotics*, 2005, section 13.6; review section 3.3.1 [R-21].

    Example:
        >>> import jax.numpy as jnp
        >>> from jaxloc.slam.fast_slam import Candidates, Landmarks, associate
        >>> known = Landmarks(jnp.zeros((3, 2)), jnp.zeros((3, 2, 2)), jnp.array([True, True, False]), jnp.ones(3, int))
        >>> residuals = jnp.array([[0.0, 0.0], [0.1, 0.0], [0.0, 0.0]])
        >>> covariances = jnp.tile(0.01 * jnp.eye(2), (3, 1, 1))
        >>> alike = Candidates(jnp.array([False, True, True]), jnp.zeros(3), jnp.array(-9.0), jnp.array(-1))
        >>> found = associate(known, residuals, covariances, jnp.array(-1), alike)
        >>> int(found.row), bool(found.fresh)  # row 0 is nearer, but has another descriptor
        (1, False)
    """
    capacity = known.seen.shape[0]
    roots = jax.vmap(cholesky)(covariances)
    squared = jnp.sum(jax.vmap(whiten)(roots, residuals) ** 2, axis=1)
    within = gate(squared, 2, LIKELY)
    allowed = known.seen & candidates.alike & within
    scores = jnp.where(allowed, _log_density(squared, roots) + candidates.log_ratios, -jnp.inf)
    best = jnp.argmax(scores).astype(jnp.int32)
    unlike = ~allowed[best] | (scores[best] < candidates.log_new)
    own = jnp.where(jnp.all(known.seen), capacity, jnp.argmin(known.seen)).astype(jnp.int32)
    free = jnp.where(candidates.free < 0, own, candidates.free.astype(jnp.int32))
    numbered = number >= 0
    row = jnp.where(numbered, number.astype(jnp.int32), jnp.where(unlike, free, best))
    inside = jnp.minimum(row, capacity - 1)
    return Association(row, within[inside], jnp.where(numbered, ~known.seen[inside], unlike))


def log_density(residual: Float[Array, "2"], covariance: Float[Array, "2 2"]) -> Float[Array, ""]:
    """Log density of a zero-mean normal residual."""
    root = cholesky(covariance)
    return _log_density(jnp.sum(whiten(root, residual) ** 2)[None], root[None])[0]


def _log_density(squared: Float[Array, " k"], roots: Float[Array, "k 2 2"]) -> Float[Array, " k"]:
    volumes = jnp.sum(jnp.log(jnp.diagonal(roots, axis1=-2, axis2=-1)), axis=-1)
    return -0.5 * squared - volumes - math.log(2.0 * math.pi)
