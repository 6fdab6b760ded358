"""Relative pose of two calibrated views from correspondences with outliers."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key

from jaxloc._arguments import checked
from jaxloc._jit import filter_jit
from jaxloc._linalg import matmul
from jaxloc._tree import detach_unless
from jaxloc.multiview.epipolar import (
    EpipolarError,
    RelativePose,
    depth_signs,
    homogeneous,
    sampson_components,
    unit_rays,
)
from jaxloc.multiview.five_point import decompose, essential_candidates, facing
from jaxloc.multiview.homography import transfer_error
from jaxloc.poses import retract
from jaxloc.solvers import Estimate, LevenbergMarquardt, Loss, Status, Tukey, align_points, solve
from jaxloc.solvers.cholesky import factor
from jaxloc.solvers.ransac import RobustEstimate, sample_indices

# Quantile of 99 % of the absolute value of a normal variable.
_GATE = 2.58
_SAMPLE = 5
# Correspondences in a subset of local optimization.
_SUBSET = 10
# Greatest probability that all samples contained an outlier.
_MISS_PROBABILITY = 0.05
# First width of the Tukey weights in the search for a rotation, sigmas.
_FIRST_WIDTH = 200.0


class ConsensusOptions(eqx.Module):
    """Options of the search for a relative pose.

    Attributes:
        hypotheses: samples of five points; each gives up to ten essential matrices.
        pretest: number of random correspondences on which all hypotheses are scored first.
        finalists: number of the best ones, scored on all correspondences.
        refined: number of the best of these, refined on the manifold and scored again.
        steps: Gauss-Newton steps of the refinement.
        rounds: rounds of local optimization.
        subsets: random subsets of the inliers a round.
    """

    hypotheses: int = eqx.field(static=True, default=128)
    pretest: int = eqx.field(static=True, default=128)
    finalists: int = eqx.field(static=True, default=16)
    refined: int = eqx.field(static=True, default=2)
    steps: int = eqx.field(static=True, default=6)
    rounds: int = eqx.field(static=True, default=2)
    subsets: int = eqx.field(static=True, default=16)


class _Pairs(NamedTuple):
    """Correspondences with finite values.

    Attributes:
        first: "3 n", homogeneous.
        second: "3 n".
        sigma: of a coordinate.
        valid: correspondences that are used.
    """

    first: Float[Array, "3 n"]
    second: Float[Array, "3 n"]
    sigma: Float[Array, ""]
    valid: Bool[Array, " n"]


@filter_jit
@checked
def estimate_relative_pose(
    first: Float[Array, "n 2"],
    second: Float[Array, "n 2"],
    *,
    sigma: Any,
    key: Key[Array, ""],
    valid: Bool[Array, " n"] | None = None,
    loss: Loss | None = None,
    consensus: ConsensusOptions = ConsensusOptions(),  # noqa: B008 (an immutable record)
) -> RobustEstimate:
    """Rotation and direction of translation between two calibrated views, with covariance and inliers.

    Essential matrices of five-point samples are scored by truncated squared Sampson distances (MSAC). The best are
    refined on the manifold of essential matrices by reweighted Gauss-Newton steps, then by refits to subsets of the
    inliers (local optimization); the result is the initial value of a robust minimum over all correspondences, whose
    derivatives the estimate has.

    Args:
        first: normalized points of the first view (`Pinhole.normalize`), without unit.
        second: the corresponding points of the second view.
        sigma: standard deviation of a coordinate in either view, normalized: px over focal length.
        key: random key.
        valid: correspondences that are used; non-finite ones never are.
        loss: kernel of the minimum, in sigmas; Tukey's of 95 % efficiency if None.
        consensus: options of the search.

    Returns:
        Estimate of the `RelativePose` ``T_first_second``, and which pairs agree with it; the tangent is (direction,
        rotation), five numbers. ``ok`` is False when there are too few inliers, when no outlier-free sample was to be
        expected with so few of them (95 %: raise `hypotheses`), and when a rotation alone explains the data: without
        parallax there is no direction. Points of a plane suffice, though two poses may explain them.

    Raises:
        ValueError: fewer than five correspondences.

    References:
        Nister 2004; Chum, Matas, Kittler, "Locally optimized RANSAC", DAGM 2003 [K-60, K-61]; Torr and Zisserman 2000;
        monocular scale is free [K-88].

    Example:
        >>> import jax, jax.numpy as jnp, jaxloc as jl
        >>> keys = jax.random.split(jax.random.key(0), 3)
        >>> points = jax.random.uniform(keys[0], (60, 3), minval=-2.0, maxval=2.0) + jnp.array([[0.0, 0.0, 6.0]])
        >>> T_first_second = jl.poses.SE3.exp(jnp.array([0.6, 0.0, 0.8, 0.05, -0.1, 0.02]))
        >>> seen = [p[:, :2] / p[:, 2:] for p in (points, T_first_second.inverse().apply(points))]
        >>> second = seen[1].at[:15].set(jax.random.uniform(keys[1], (15, 2)))
        >>> found = jl.multiview.two_view.estimate_relative_pose(seen[0], second, sigma=1e-3, key=keys[2])
        >>> direction = T_first_second.translation / jnp.linalg.norm(T_first_second.translation)
        >>> bool(found.ok), bool(jnp.abs(found.value.direction.vector - direction).max() < 1e-2)
        (True, True)
        >>> bool(found.inliers[:15].sum() < 5), bool(found.inliers[15:].mean() > 0.95)
        (True, True)
    """
    n = first.shape[0]
    if n < _SAMPLE:
        raise ValueError(f"A relative pose needs {_SAMPLE} correspondences; there are {n}.")
    pairs = _finite_pairs(first, second, sigma, valid)
    frozen = lax.stop_gradient(pairs)
    initial, inliers = _search(frozen, key, consensus)
    loss = Tukey(jnp.asarray(4.685, first.dtype)) if loss is None else loss
    problem = EpipolarError(pairs.first, pairs.second, pairs.sigma, pairs.valid, loss)
    fit = solve(problem, initial, solver=LevenbergMarquardt())
    return _validate(fit, frozen, inliers, consensus.hypotheses)


def _finite_pairs(first: Array, second: Array, sigma: Any, valid: Bool[Array, " n"] | None) -> _Pairs:
    finite = jnp.all(jnp.isfinite(first), axis=1) & jnp.all(jnp.isfinite(second), axis=1)
    used = finite if valid is None else finite & valid
    first, second = (jnp.where(used[:, None], points, 0.0) for points in (first, second))
    return _Pairs(homogeneous(first), homogeneous(second), jnp.asarray(sigma, first.dtype), used)


def _search(pairs: _Pairs, key: Key[Array, ""], options: ConsensusOptions) -> tuple[RelativePose, Bool[Array, " n"]]:
    """The pose with the lowest MSAC cost, and its inliers."""
    draw, order, inner = jax.random.split(key, 3)
    chosen = sample_indices(draw, pairs.valid, _SAMPLE, options.hypotheses)
    rays = [unit_rays(points.T) for points in (pairs.first, pairs.second)]
    essentials, usable = essential_candidates(rays[0][chosen], rays[1][chosen])
    essentials = essentials.reshape(-1, 3, 3)
    essentials = _select(
        essentials, usable.reshape(-1), _random_subset(pairs, order, options.pretest), options.finalists
    )
    essentials = _select(essentials, jnp.ones(len(essentials), bool), pairs, options.refined)
    poses = jax.vmap(lambda essential: _refine(decompose(essential), pairs, options.steps))(essentials)
    pose = _lowest_cost(poses, pairs, 1)
    rounds = jax.random.split(inner, options.rounds)
    pose, _ = lax.scan(lambda pose, key: (_optimize_locally(pose, pairs, key, options.subsets), None), pose, rounds)
    pose = jax.tree.map(lambda leaf: leaf[0], pose)
    inliers = _inliers(pose, pairs)
    return facing(pose, pairs.first.T, pairs.second.T, inliers.astype(pairs.sigma.dtype)), inliers


def _optimize_locally(pose: RelativePose, pairs: _Pairs, key: Key[Array, ""], count: int) -> RelativePose:
    """Local optimization: the pose is refined on subsets of its inliers, and the best result is kept.

    An outlier among the inliers keeps a pose in a local minimum of the cost, or of any robust kernel; most small
    subsets do not contain it.

    Args:
        pose: a stack of one.
        pairs: all correspondences.
        key: random key.
        count: of subsets.
    """
    best = jax.tree.map(lambda leaf: leaf[0], pose)
    chosen = sample_indices(key, _inliers(best, pairs), _SUBSET, count)

    def refit(index: Int[Array, " m"]) -> RelativePose:
        some = _Pairs(pairs.first[:, index], pairs.second[:, index], pairs.sigma, pairs.valid[index])
        return _refine(best, some, 3)

    poses = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), pose, jax.vmap(refit)(chosen))
    poses = _lowest_cost(poses, pairs, 2)
    refined = jax.vmap(lambda pose: _refine(pose, pairs, 3))(poses)
    return _lowest_cost(jax.tree.map(lambda *leaves: jnp.concatenate(leaves), poses, refined), pairs, 1)


def _lowest_cost(poses: RelativePose, pairs: _Pairs, count: int) -> RelativePose:
    """The `count` poses with the lowest costs."""
    costs = _msac_costs(jax.vmap(lambda pose: pose.essential())(poses), pairs)
    _, index = lax.top_k(-costs, count)
    return jax.tree.map(lambda leaf: leaf[index], poses)


def _random_subset(pairs: _Pairs, key: Key[Array, ""], count: int) -> _Pairs:
    """Random correspondences, valid ones first."""
    rank = jax.random.uniform(key, pairs.valid.shape)
    index: Int[Array, " m"] = jnp.argsort(jnp.where(pairs.valid, rank, 2.0))[:count]
    return _Pairs(pairs.first[:, index], pairs.second[:, index], pairs.sigma, pairs.valid[index])


def _select(essentials: Float[Array, "k 3 3"], usable: Bool[Array, " k"], pairs: _Pairs, count: int) -> Array:
    costs = jnp.where(usable, _msac_costs(essentials, pairs), jnp.inf)
    _, index = lax.top_k(-costs, min(count, len(essentials)))
    return essentials[index]


def _msac_costs(essentials: Float[Array, "k 3 3"], pairs: _Pairs) -> Float[Array, " k"]:
    """Sum of truncated squared Sampson distances, for all hypotheses at once by matrix products."""
    k = len(essentials)
    x1, x2 = pairs.first, pairs.second
    rays = (x1[:, None] * x2[None]).reshape(9, -1)
    error = matmul(essentials.reshape(k, 9), rays)
    lines = [matmul(essentials[:, i, :], x2) for i in (0, 1)] + [matmul(essentials[:, :, i], x1) for i in (0, 1)]
    squared = sum(line * line for line in lines) * (_GATE * pairs.sigma) ** 2
    ratio = error * error / jnp.where(squared > 0, squared, 1.0)
    cost = jnp.where(squared > 0, jnp.minimum(ratio, 1.0), 1.0)
    return jnp.sum(jnp.where(pairs.valid[None, :], cost, 0.0), axis=1)


def _refine(pose: RelativePose, pairs: _Pairs, steps: int) -> RelativePose:
    """Reweighted Gauss-Newton steps on squared Sampson distances, with Tukey weights of decreasing width."""
    zero = jnp.zeros(5, pairs.first.dtype)

    def step(pose: RelativePose, width: Array) -> tuple[RelativePose, None]:
        def whitened(delta: Array) -> Array:
            return sampson_components(retract(pose, delta).essential(), pairs.first, pairs.second) / pairs.sigma

        residual, tangent_map = jax.linearize(whitened, zero)
        jacobian = jax.vmap(tangent_map)(jnp.eye(5, dtype=zero.dtype))
        weight = jnp.where(pairs.valid, jnp.maximum(1.0 - (residual / width) ** 2, 0.0) ** 2, 0.0)
        weighted = jacobian * weight[None, :]
        delta = factor(matmul(weighted, jacobian.T)).solve(matmul(weighted, residual))
        delta = jnp.clip(jnp.where(jnp.isfinite(delta), delta, 0.0), -0.2, 0.2)
        return retract(pose, -delta), None

    widths = jnp.linspace(9.0, 4.685, steps, dtype=zero.dtype)
    return lax.scan(step, pose, widths)[0]


def _inliers(pose: RelativePose, pairs: _Pairs) -> Bool[Array, " n"]:
    error = sampson_components(pose.essential(), pairs.first, pairs.second)
    return pairs.valid & (jnp.abs(error) < _GATE * pairs.sigma)


def _validate(fit: Estimate, pairs: _Pairs, before: Bool[Array, " n"], hypotheses: int) -> RobustEstimate:
    """Valid if more points agree than by chance, enough samples were drawn, and a rotation alone does not suffice."""
    pose = lax.stop_gradient(fit.value)
    inliers = _inliers(pose, pairs)
    count, number = (jnp.sum(mask).astype(pairs.sigma.dtype) for mask in (inliers, pairs.valid))
    points = jnp.where(pairs.valid[None, :], pairs.first[:2], 0.0)
    mean = jnp.sum(points, axis=1, keepdims=True) / jnp.maximum(number, 1.0)
    variance = jnp.sum(jnp.where(pairs.valid[None, :], (points - mean) ** 2, 0.0)) / jnp.maximum(2.0 * number, 1.0)
    # Fraction of the image within the gate of an epipolar line: the probability of agreement by chance.
    chance = 2.0 * _GATE * pairs.sigma / jnp.sqrt(jnp.maximum(6.0 * variance, pairs.sigma**2))
    enough = count > 2.0 * _SAMPLE + 6.0 * jnp.minimum(chance, 1.0) * number
    # The same test for translation: it must explain more pairs than outliers and noise do.
    beyond = jnp.sum(inliers & _unexplained_by_rotation(pairs, inliers)).astype(count.dtype)
    moved = beyond > 2.0 * _SAMPLE + (6.0 * jnp.minimum(chance, 1.0) + 0.02) * number
    in_front = _num_in_front(pose, pairs, inliers) > 0.5 * count
    # Probability that some sample had no outlier, given the fraction of inliers.
    fraction = jnp.clip(count / jnp.maximum(number, 1.0) - chance, 0.0, 1.0)
    searched = (1.0 - fraction**_SAMPLE) ** hypotheses < _MISS_PROBABILITY
    ok = fit.ok & enough & searched & (jnp.sum(before) > _SAMPLE)
    status = jnp.where(moved & in_front, fit.status, int(Status.RANK_DEFICIENT))
    status = jnp.where(ok | ~fit.ok, status, int(Status.INADMISSIBLE))
    ok = ok & moved & in_front
    value, covariance = detach_unless(ok, (fit.value, fit.covariance))
    fit = eqx.tree_at(lambda e: (e.value, e.covariance, e.ok, e.status), fit, (value, covariance, ok, status))
    return RobustEstimate(fit, inliers)


def _unexplained_by_rotation(pairs: _Pairs, inliers: Bool[Array, " n"]) -> Bool[Array, " n"]:
    """Pairs whose residual under the best rotation, found by reweighting, exceeds the noise (99 %)."""
    rays = [unit_rays(points.T) for points in (pairs.first, pairs.second)]

    def distance(rotation: Array) -> Float[Array, " n"]:
        error = transfer_error(rotation, pairs.second[:2], pairs.first[:2], pairs.sigma, inliers)
        return jnp.sqrt(jnp.sum(error**2, axis=0))

    def reweight(weights: Array, width: Array) -> tuple[Array, Array]:
        rotation = align_points(rays[1], rays[0], weights=weights, valid=inliers).value.rotation.matrix()
        return jnp.maximum(1.0 - (distance(rotation) / width) ** 2, 0.0) ** 2, rotation

    widths = jnp.geomspace(_FIRST_WIDTH, 4.685, 8, dtype=pairs.sigma.dtype)
    _, rotations = lax.scan(reweight, jnp.ones_like(rays[0][:, 0]), widths)
    return distance(rotations[-1]) > 3.03


def _num_in_front(pose: RelativePose, pairs: _Pairs, inliers: Bool[Array, " n"]) -> Float[Array, ""]:
    """Number of inliers in front of both cameras."""
    rotated = matmul(pose.rotation.matrix(), pairs.second)
    signs = depth_signs(pose.direction.vector, pairs.first.T, rotated.T)
    return jnp.sum(inliers & jnp.all(signs > 0, axis=0)).astype(signs.dtype)
