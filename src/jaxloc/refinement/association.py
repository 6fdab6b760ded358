"""Which feature of the map is which in the image: attributes, a pose, and what the others say.

Without knowledge n features can be matched in n! ways. Five sources of information cut that down (Kelly's list), each a
record that can be left out:

- *richness*: attributes such as a barcode, a block of pixels, the eigenvalues of a corner, a curvature;
- *pose*: a predicted place with its covariance: gate and cost by Mahalanobis distance;
- *separation*: a pair with a rival that is about as good is ambiguous, and better left out;
- *consensus*: distances between features are the same in both frames, so right pairs support one another;
- *conditioning*: some wrong pairs may be among the rest: a robust pose is fitted, and what departs from it left out.

References:
    A. Kelly, *Mobile Robotics*, lecture 9.2.3.3 and 9.2.3.5 [K-55, K-58, K-59].
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

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
    """Attributes count: gated each by itself, and added to the cost.

    Attributes:
        gate: greatest squared distance in sigmas of one attribute.
    """

    gate: float = 16.0


class PoseGate(eqx.Module):
    """The predicted pose counts, with its covariance.

    Attributes:
        gate: greatest squared Mahalanobis distance.
    """

    gate: float = 16.0


class Separation(eqx.Module):
    """Pairs with a rival in their row or column are left out.

    Attributes:
        margin: by which the cost of the rival has to be greater.
    """

    margin: float = 4.0


class PairConsensus(eqx.Module):
    """Pairs that few others agree with cost more.

    Attributes:
        sigma: standard deviation of a distance between two features, m; None takes that of the points.
        weight: cost of a pair that nobody supports.
    """

    sigma: float | None = None
    weight: float = 60.0


class Conditioning(eqx.Module):
    """A robust pose is fitted to the pairs, and those that depart from it are left out.

    Attributes:
        scale: of the robust kernel, sigmas.
        gate: greatest distance from where the fitted pose has a feature, sigmas.
    """

    scale: float = 3.0
    gate: float = 4.0


class Sources(eqx.Module):
    """Which of the five sources of information are used; None leaves one out [K-59]."""

    richness: Richness | None = Richness()
    pose: PoseGate | None = PoseGate()
    separation: Separation | None = Separation()
    consensus: PairConsensus | None = PairConsensus()
    conditioning: Conditioning | None = Conditioning()


class Costs(eqx.Module):
    """What pairs cost.

    Attributes:
        values: in units of a squared sigma; zero where not feasible.
        feasible: pairs within all gates.
    """

    values: Float[Array, "n m"]
    feasible: Bool[Array, "n m"]


class Association(eqx.Module):
    """Which map feature each seen feature is.

    Attributes:
        columns: index of the map feature, -1 for none.
        costs: of all pairs.
        total: cost of the assignment before pairs were left out.
    """

    columns: Int[Array, " n"]
    costs: Costs
    total: Float[Array, ""]


@eqx.filter_jit
def pair_costs(
    pose: Gaussian, seen: Features, known: Features, *, sources: Sources = Sources(), sigma: Any = 0.05
) -> Costs:
    """Composite cost of each pair of a seen and a known feature, and which pairs are possible at all.

    Sum of the squared Mahalanobis distance of the places, with covariance ``J P J^T + sigma^2``, and of the squared
    distances of the attributes, each within its gate; with consensus, what is lacking of support by other pairs.

    Args:
        pose: of the sensor on the map, ``T_map_sensor``, `SE2` or `SE3`, with its covariance.
        seen: features in the frame of the sensor.
        known: features of the map.
        sources: of information that are used; separation and conditioning have no part in costs.
        sigma: standard deviation of a coordinate of the difference, m.

    Returns:
        The costs.

    Raises:
        ValueError: attributes of the two sides differ in number or kind.

    References:
        KELLY 9.2.3.5 [K-55, K-58, K-59].
    """
    kinds = [[type(attribute) for attribute in side.attributes] for side in (seen, known)]
    if kinds[0] != kinds[1]:
        raise ValueError(f"Seen features have the attributes {kinds[0]}, known ones {kinds[1]}: give the same.")
    usable = seen.usable(), known.usable()
    here, there = (jnp.where(u[:, None], f.points, 0.0) for u, f in zip(usable, (seen, known), strict=True))
    feasible = usable[0][:, None] & usable[1][None, :]
    values = jnp.zeros(feasible.shape, here.dtype)
    if sources.pose is not None:
        squared = _mahalanobis(pose, here, there, sigma)
        values, feasible = values + squared, feasible & (squared <= sources.pose.gate)
    if sources.richness is not None:
        for mine, theirs in zip(seen.attributes, known.attributes, strict=True):
            squared = mine.squared_distance(theirs).astype(here.dtype)
            close = squared <= sources.richness.gate  # false for nan
            values, feasible = values + jnp.where(close, squared, 0.0), feasible & close
    values = jnp.where(feasible, values, 0.0)
    if sources.consensus is not None:
        values = values + _lacking_support(sources.consensus, here, there, feasible, sigma)
    return Costs(jnp.where(feasible, values, 0.0), feasible)


@eqx.filter_jit
def associate(
    pose: Gaussian, seen: Features, known: Features, *, sources: Sources = Sources(), sigma: Any = 0.05
) -> Association:
    """The best one-to-one association of seen features with known ones.

    As many possible pairs as there can be, at the least total cost; then ambiguous and departing pairs are left out.

    Args:
        pose: of the sensor on the map, ``T_map_sensor``, with its covariance.
        seen: features in the frame of the sensor.
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
        >>> seen = Features(jnp.array([[1.05, 0.0], [1.05, 0.1]]), (Identity(jnp.array([8, 7])),))
        >>> associate(pose, seen, known).columns.tolist()
        [1, 0]
    """
    costs = pair_costs(pose, seen, known, sources=sources, sigma=sigma)
    best = assign(costs.values, costs.feasible)
    columns = best.columns
    if sources.separation is not None:
        columns = _unambiguous(columns, costs, sources.separation)
    if sources.conditioning is not None:
        columns = _agreeing(columns, pose.mean, seen, known, sources.conditioning, sigma)
    return Association(columns, costs, best.cost)


def _mahalanobis(pose: Gaussian, seen: Array, known: Array, sigma: Any) -> Float[Array, "n m"]:
    """Squared distances of predicted places from known ones, by the covariance of each prediction."""
    mean: SE2 | SE3 = pose.mean
    linear = PointPoint(seen, seen).linearize(mean)
    predicted = mean.apply(seen)
    eye = jnp.eye(seen.shape[1], dtype=seen.dtype)

    def one(place: Array, slope: Float[Array, "d k"]) -> Float[Array, " m"]:
        spread = matmul(slope.T, matmul(pose.covariance, slope)) + jnp.asarray(sigma, seen.dtype) ** 2 * eye
        gaps = known - place[None, :]
        return jnp.sum(gaps * matmul(gaps, factor(spread).inverse()), axis=1)

    return jax.vmap(one)(predicted, jnp.moveaxis(linear.jacobian, -1, 0))


def _lacking_support(
    consensus: PairConsensus, seen: Array, known: Array, feasible: Bool[Array, "n m"], sigma: Any
) -> Float[Array, "n m"]:
    """Cost of a pair (i, j): the part of the other features k that have no l with ``|x_i - x_k| = |y_j - y_l|``."""
    spread = jnp.asarray(2.0 * sigma if consensus.sigma is None else consensus.sigma, seen.dtype)
    inside, outside = (_distances(points) for points in (seen, known))
    alone = jnp.any(feasible, axis=1)
    count = jnp.maximum(jnp.sum(alone) - 1, 1).astype(seen.dtype)

    def row(index: Int[Array, ""]) -> Float[Array, " m"]:
        # "k j l": how well the distance to k is that from j to l.
        gap = (inside[index][:, None, None] - outside[None, :, :]) / spread
        likeness = jnp.where(feasible[:, None, :], jnp.exp(-0.5 * gap * gap), 0.0)
        others = (jnp.arange(seen.shape[0]) != index)[:, None]
        return jnp.sum(jnp.where(others, jnp.max(likeness, axis=2), 0.0), axis=0) / count

    support = lax.map(row, jnp.arange(seen.shape[0]))
    return consensus.weight * (1.0 - jnp.clip(support, 0.0, 1.0))


def _unambiguous(columns: Int[Array, " n"], costs: Costs, separation: Separation) -> Int[Array, " n"]:
    """Without pairs that have a rival within the margin, in their row or in their column."""
    safe = jnp.where(costs.feasible, costs.values, jnp.inf)
    taken = columns >= 0
    place = jnp.where(taken, columns, 0)
    own = jnp.take_along_axis(safe, place[:, None], axis=1)[:, 0]
    rows, width = jnp.arange(safe.shape[0]), safe.shape[1]
    in_row = jnp.min(jnp.where(jnp.arange(width)[None, :] == place[:, None], jnp.inf, safe), axis=1)
    by_column = safe[:, place].T
    in_column = jnp.min(jnp.where(rows[None, :] == rows[:, None], jnp.inf, by_column), axis=1)
    apart = jnp.minimum(in_row, in_column) - jnp.where(taken, own, 0.0) >= separation.margin
    return jnp.where(taken & apart, columns, -1)


def _agreeing(
    columns: Int[Array, " n"], pose: SE2 | SE3, seen: Features, known: Features, rule: Conditioning, sigma: Any
) -> Int[Array, " n"]:
    """Without pairs that a robust fit of the pose leaves far apart; all of them where no pose can be fitted."""
    taken = columns >= 0
    partners = known.points[jnp.where(taken, columns, 0)]
    pairs = PointPoint(seen.points, partners, sigma=sigma, valid=taken)
    fit = refine(Correspondences(pairs), pose, loss=GemanMcClure(rule.scale))
    gaps = jnp.where(taken[:, None], fit.value.apply(jnp.where(taken[:, None], seen.points, 0.0)) - partners, 0.0)
    near = jnp.sum(gaps**2, axis=1) <= (rule.gate * jnp.asarray(sigma, gaps.dtype)) ** 2
    return jnp.where(near | ~fit.ok, columns, -1)


def _distances(points: Float[Array, "n k"]) -> Float[Array, "n n"]:
    squared = jnp.sum((points[:, None, :] - points[None, :, :]) ** 2, axis=2)
    some = squared > 0
    return jnp.where(some, jnp.sqrt(jnp.where(some, squared, 1.0)), 0.0)
