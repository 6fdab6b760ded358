"""Data association of features with a map: attributes, predicted pose, ambiguity, consensus and robust fitting.

n features can be matched in n! ways. Five sources of information reduce that (Kelly's list), each an optional record:

- *richness*: attributes such as a barcode, a block of pixels, the eigenvalues of a corner, a curvature;
- *pose*: a predicted position with covariance: gate and cost by Mahalanobis distance;
- *separation*: a pair with an alternative of about the same cost is ambiguous, and removed;
- *consensus*: distances between features are the same in both frames, so that correct pairs support each other;
- *conditioning*: outliers of a robust pose that is fitted to the remaining pairs are removed.

References:
    A. Kelly, *Mobile Robotics*, lecture 9.2.3.3 and 9.2.3.5 [K-55, K-58, K-59].
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxloc._jit import filter_jit
from jaxloc._linalg import matmul
from jaxloc.beliefs import Gaussian
from jaxloc.poses import SE2, SE3
from jaxloc.refinement.attributes import Attribute, Blocks, CornerStrength, Curvature, Identity
from jaxloc.refinement.correspondences import Correspondences, PointPoint, refine
from jaxloc.solvers import GemanMcClure, assign
from jaxloc.solvers.cholesky import factor

__all__ = [
    "Association",
    "Attribute",
    "Blocks",
    "Conditioning",
    "CornerStrength",
    "Costs",
    "Curvature",
    "Features",
    "Identity",
    "PairConsensus",
    "PoseGate",
    "Richness",
    "Separation",
    "Sources",
    "associate",
    "pair_costs",
]


class Features(eqx.Module):
    """Features of one frame.

    Attributes:
        points: "n k", m, k = 2 or 3.
        attributes: any, in the same order on both sides.
        valid: slots that hold a feature.
    """

    points: Float[Array, "n k"]
    attributes: tuple[Attribute, ...] = ()
    valid: Bool[Array, " n"] | None = None

    def usable(self) -> Bool[Array, " n"]:
        """Slots that hold a feature with finite numbers."""
        finite = jnp.all(jnp.isfinite(self.points), axis=1)
        return finite if self.valid is None else finite & self.valid


class Richness(eqx.Module):
    """Use of attributes: each is gated, and added to the cost.

    Attributes:
        gate: greatest squared distance in sigmas of one attribute.
    """

    gate: float = 16.0


class PoseGate(eqx.Module):
    """Use of the predicted pose with its covariance.

    Attributes:
        gate: greatest squared Mahalanobis distance.
    """

    gate: float = 16.0


class Separation(eqx.Module):
    """Removal of ambiguous pairs, with an alternative in their row or column.

    Attributes:
        margin: least excess of the cost of the alternative.
    """

    margin: float = 4.0


class PairConsensus(eqx.Module):
    """Additional cost of pairs with little support by other pairs.

    Attributes:
        sigma: standard deviation of a distance between two features, m; None takes that of the points.
        weight: cost of a pair without any support.
    """

    sigma: float | None = None
    weight: float = 60.0


class Conditioning(eqx.Module):
    """Removal of outliers of a robust pose that is fitted to the pairs.

    Attributes:
        scale: of the robust kernel, sigmas.
        gate: greatest distance under the fitted pose, sigmas.
    """

    scale: float = 3.0
    gate: float = 4.0


class Sources(eqx.Module):
    """The five sources of information; None disables one [K-59]."""

    richness: Richness | None = Richness()
    pose: PoseGate | None = PoseGate()
    separation: Separation | None = Separation()
    consensus: PairConsensus | None = PairConsensus()
    conditioning: Conditioning | None = Conditioning()


class Costs(eqx.Module):
    """Costs of all pairs.

    Attributes:
        values: in units of a squared sigma; zero where not feasible.
        feasible: pairs within all gates.
    """

    values: Float[Array, "n m"]
    feasible: Bool[Array, "n m"]


class Association(eqx.Module):
    """Association of observed features with map features.

    Attributes:
        columns: index of the map feature, -1 for none.
        costs: of all pairs.
        total: cost of the assignment before pairs were removed.
    """

    columns: Int[Array, " n"]
    costs: Costs
    total: Float[Array, ""]


@filter_jit
def pair_costs(
    pose: Gaussian, observed: Features, known: Features, *, sources: Sources = Sources(), sigma: Any = 0.05
) -> Costs:
    """Composite costs of pairs of an observed and a map feature, and which pairs are feasible.

    Sum of the squared Mahalanobis distance of the positions, with covariance ``J P J^T + sigma^2``, and of the squared
    distances of the attributes, each within its gate; with consensus, the lack of support by other pairs.

    Args:
        pose: of the sensor on the map, ``T_map_sensor``, `SE2` or `SE3`, with its covariance.
        observed: features in the frame of the sensor.
        known: features of the map.
        sources: of information that are used; separation and conditioning do not enter costs.
        sigma: standard deviation of a coordinate of the difference, m.

    Returns:
        The costs.

    Raises:
        ValueError: attributes of the two sides differ in number or kind.

    References:
        KELLY 9.2.3.5 [K-55, K-58, K-59].
    """
    kinds = [[type(attribute) for attribute in side.attributes] for side in (observed, known)]
    if kinds[0] != kinds[1]:
        raise ValueError(
            f"The observed features have the attributes {kinds[0]}, the map's features {kinds[1]}: give the same."
        )
    usable = observed.usable(), known.usable()
    here, there = (jnp.where(u[:, None], f.points, 0.0) for u, f in zip(usable, (observed, known), strict=True))
    feasible = usable[0][:, None] & usable[1][None, :]
    values = jnp.zeros(feasible.shape, here.dtype)
    if sources.pose is not None:
        squared = _mahalanobis(pose, here, there, sigma)
        values, feasible = values + squared, feasible & (squared <= sources.pose.gate)
    if sources.richness is not None:
        for mine, theirs in zip(observed.attributes, known.attributes, strict=True):
            squared = mine.squared_distance(theirs).astype(here.dtype)
            close = squared <= sources.richness.gate  # false for nan
            values, feasible = values + jnp.where(close, squared, 0.0), feasible & close
    values = jnp.where(feasible, values, 0.0)
    if sources.consensus is not None:
        values = values + _support_cost(sources.consensus, here, there, feasible, sigma)
    return Costs(jnp.where(feasible, values, 0.0), feasible)


@filter_jit
def associate(
    pose: Gaussian, observed: Features, known: Features, *, sources: Sources = Sources(), sigma: Any = 0.05
) -> Association:
    """Optimal one-to-one association of observed features with map features.

    The largest number of feasible pairs at the least total cost; then ambiguous pairs and outliers are removed.

    Args:
        pose: of the sensor on the map, ``T_map_sensor``, with its covariance.
        observed: features in the frame of the sensor.
        known: features of the map.
        sources: of information that are used.
        sigma: standard deviation of a coordinate of the difference, m.

    Returns:
        The association.

    References:
        KELLY 9.2.3.5 [K-58, K-59].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> from jaxloc.refinement.association import Features, Identity, associate
        >>> pose = jl.beliefs.Gaussian(jl.poses.SE2(0.0, 0.0, 0.0), jnp.eye(3) * 0.01)
        >>> known = Features(jnp.array([[1.0, 0.0], [1.1, 0.0]]), (Identity(jnp.array([7, 8])),))
        >>> observed = Features(jnp.array([[1.05, 0.0], [1.05, 0.1]]), (Identity(jnp.array([8, 7])),))
        >>> associate(pose, observed, known).columns.tolist()
        [1, 0]
    """
    costs = pair_costs(pose, observed, known, sources=sources, sigma=sigma)
    best = assign(costs.values, costs.feasible)
    columns = best.columns
    if not costs.feasible.size:
        return Association(columns, costs, best.cost)
    if sources.separation is not None:
        columns = _unambiguous(columns, costs, sources.separation)
    if sources.conditioning is not None:
        columns = _inliers(columns, pose.mean, observed, known, sources.conditioning, sigma)
    return Association(columns, costs, best.cost)


def _mahalanobis(pose: Gaussian, observed: Array, known: Array, sigma: Any) -> Float[Array, "n m"]:
    """Squared Mahalanobis distances of predicted positions from those of the map."""
    mean: SE2 | SE3 = pose.mean
    linear = PointPoint(observed, observed).linearize(mean)
    predicted = mean.apply(observed)
    eye = jnp.eye(observed.shape[1], dtype=observed.dtype)

    def one(place: Array, slope: Float[Array, "d k"]) -> Float[Array, " m"]:
        covariance = matmul(slope.T, matmul(pose.covariance, slope)) + jnp.asarray(sigma, observed.dtype) ** 2 * eye
        gaps = known - place[None, :]
        return jnp.sum(gaps * matmul(gaps, factor(covariance).inverse()), axis=1)

    return jax.vmap(one)(predicted, jnp.moveaxis(linear.jacobian, -1, 0))


def _support_cost(
    consensus: PairConsensus, observed: Array, known: Array, feasible: Bool[Array, "n m"], sigma: Any
) -> Float[Array, "n m"]:
    """Cost of a pair (i, j): the part of the other features k that have no l with ``|x_i - x_k| = |y_j - y_l|``."""
    if not feasible.size:
        return jnp.zeros(feasible.shape, observed.dtype)
    deviation = jnp.asarray(2.0 * sigma if consensus.sigma is None else consensus.sigma, observed.dtype)
    inside, outside = (_distances(points) for points in (observed, known))
    feasible_rows = jnp.any(feasible, axis=1)
    count = jnp.maximum(jnp.sum(feasible_rows) - 1, 1).astype(observed.dtype)

    def row(index: Int[Array, ""]) -> Float[Array, " m"]:
        # "k j l": agreement of the distance to k with that from j to l.
        gap = (inside[index][:, None, None] - outside[None, :, :]) / deviation
        agreement = jnp.where(feasible[:, None, :], jnp.exp(-0.5 * gap * gap), 0.0)
        others = (jnp.arange(observed.shape[0]) != index)[:, None]
        return jnp.sum(jnp.where(others, jnp.max(agreement, axis=2), 0.0), axis=0) / count

    support = lax.map(row, jnp.arange(observed.shape[0]))
    return consensus.weight * (1.0 - jnp.clip(support, 0.0, 1.0))


def _unambiguous(columns: Int[Array, " n"], costs: Costs, separation: Separation) -> Int[Array, " n"]:
    """Removes pairs with an alternative within the margin, in their row or in their column."""
    safe = jnp.where(costs.feasible, costs.values, jnp.inf)
    paired = columns >= 0
    place = jnp.where(paired, columns, 0)
    own = jnp.take_along_axis(safe, place[:, None], axis=1)[:, 0]
    rows, width = jnp.arange(safe.shape[0]), safe.shape[1]
    in_row = jnp.min(jnp.where(jnp.arange(width)[None, :] == place[:, None], jnp.inf, safe), axis=1)
    by_column = safe[:, place].T
    in_column = jnp.min(jnp.where(rows[None, :] == rows[:, None], jnp.inf, by_column), axis=1)
    distinct = jnp.minimum(in_row, in_column) - jnp.where(paired, own, 0.0) >= separation.margin
    return jnp.where(paired & distinct, columns, -1)


def _inliers(
    columns: Int[Array, " n"], pose: SE2 | SE3, observed: Features, known: Features, rule: Conditioning, sigma: Any
) -> Int[Array, " n"]:
    """Removes outliers of a robust fit of the pose; keeps all where no pose can be fitted."""
    paired = columns >= 0
    partners = known.points[jnp.where(paired, columns, 0)]
    pairs = PointPoint(observed.points, partners, sigma=sigma, valid=paired)
    fit = refine(Correspondences(pairs), pose, loss=GemanMcClure(rule.scale))
    gaps = jnp.where(paired[:, None], fit.value.apply(jnp.where(paired[:, None], observed.points, 0.0)) - partners, 0.0)
    near = jnp.sum(gaps**2, axis=1) <= (rule.gate * jnp.asarray(sigma, gaps.dtype)) ** 2
    return jnp.where(near | ~fit.ok, columns, -1)


def _distances(points: Float[Array, "n k"]) -> Float[Array, "n n"]:
    squared = jnp.sum((points[:, None, :] - points[None, :, :]) ** 2, axis=2)
    some = squared > 0
    return jnp.where(some, jnp.sqrt(jnp.where(some, squared, 1.0)), 0.0)
