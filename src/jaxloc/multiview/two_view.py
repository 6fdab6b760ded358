"""The relative pose of two calibrated views from points among which many are wrong."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key

from jaxloc._linalg import matmul
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
from jaxloc.solvers.ransac import sample_indices

# 99 % of the absolute value of a normal variable.
_GATE = 2.58
_SAMPLE = 5
# Pairs in a subset that local optimization refits.
_SUBSET = 10
# Greatest probability that no sample was free of wrong pairs.
_DOUBT = 0.05
# Sigmas at which the search for a rotation begins to doubt a pair.
_FAR = 200.0


class ConsensusOptions(eqx.Module):
    """How correspondences vote.

    Attributes:
        hypotheses: samples of five points; each gives up to ten essential matrices.
        pretest: correspondences, drawn at random, on which all of them are scored.
        finalists: the best, scored on all correspondences.
        refined: the best of these, refined on the manifold before they are voted on again.
        steps: of the refinement.
        rounds: of local optimization of the winner.
        subsets: of its inliers, tried in a round.
    """

    hypotheses: int = eqx.field(static=True, default=128)
    pretest: int = eqx.field(static=True, default=128)
    finalists: int = eqx.field(static=True, default=16)
    refined: int = eqx.field(static=True, default=2)
    steps: int = eqx.field(static=True, default=6)
    rounds: int = eqx.field(static=True, default=2)
    subsets: int = eqx.field(static=True, default=16)


class _Pairs(NamedTuple):
    """Correspondences made safe.

    Attributes:
        first: "3 n", homogeneous.
        second: "3 n".
        sigma: of a coordinate.
        valid: which count.
    """

    first: Float[Array, "3 n"]
    second: Float[Array, "3 n"]
    sigma: Float[Array, ""]
    valid: Bool[Array, " n"]


@eqx.filter_jit
def estimate_relative_pose(
    first: Float[Array, "n 2"],
    second: Float[Array, "n 2"],
    *,
    sigma: Any,
    key: Key[Array, ""],
    valid: Bool[Array, " n"] | None = None,
    loss: Loss | None = None,
    consensus: ConsensusOptions = ConsensusOptions(),  # noqa: B008 (an immutable record)
) -> Estimate:
    """Rotation and direction of translation between two calibrated views, with covariance.

    All pairs vote on five-point samples by truncated squared Sampson distances (MSAC). The best are refined on the
    manifold of essential matrices by reweighted Gauss-Newton steps, the winner is improved by refits to subsets of its
    inliers (local optimization), and is the start of a robust minimum over all correspondences. The derivatives are
    that minimum's.

    Args:
        first: normalized points of the first view (`Pinhole.normalize`), without unit.
        second: their partners in the second view.
        sigma: standard deviation of a coordinate in either view, normalized: px over focal length.
        key: random key.
        valid: which count; numbers that are not finite never do.
        loss: kernel of the minimum, in sigmas; Tukey's of 95 % efficiency if None.
        consensus: how many hypotheses are tried, and how.

    Returns:
        Estimate of the `RelativePose` ``T_first_second``; its tangent is (direction, rotation), five numbers. ``ok`` is
        False when too few points agree, when with so few of them a sample without a wrong one was not to be expected
        (95 %: raise `hypotheses`), and when a rotation alone explains them: without parallax there is no direction. A
        plane is enough, though two poses may explain it.

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
        >>> wrong = seen[1].at[:15].set(jax.random.uniform(keys[1], (15, 2)))
        >>> found = jl.multiview.two_view.estimate_relative_pose(seen[0], wrong, sigma=1e-3, key=keys[2])
        >>> towards = T_first_second.translation / jnp.linalg.norm(T_first_second.translation)
        >>> bool(found.ok), bool(jnp.abs(found.value.direction.vector - towards).max() < 1e-2)
        (True, True)
    """
    n = first.shape[0]
    if n < _SAMPLE:
        raise ValueError(f"A relative pose needs {_SAMPLE} correspondences; there are {n}.")
    pairs = _safe(first, second, sigma, valid)
    still = lax.stop_gradient(pairs)
    start, inliers = _winner(still, key, consensus)
    loss = Tukey(jnp.asarray(4.685, first.dtype)) if loss is None else loss
    problem = EpipolarError(pairs.first, pairs.second, pairs.sigma, pairs.valid, loss)
    fit = solve(problem, start, solver=LevenbergMarquardt())
    return _judged(fit, still, inliers, consensus.hypotheses)


def _safe(first: Array, second: Array, sigma: Any, valid: Bool[Array, " n"] | None) -> _Pairs:
    finite = jnp.all(jnp.isfinite(first), axis=1) & jnp.all(jnp.isfinite(second), axis=1)
    counts = finite if valid is None else finite & valid
    first, second = (jnp.where(counts[:, None], points, 0.0) for points in (first, second))
    return _Pairs(homogeneous(first), homogeneous(second), jnp.asarray(sigma, first.dtype), counts)


def _winner(pairs: _Pairs, key: Key[Array, ""], options: ConsensusOptions) -> tuple[RelativePose, Bool[Array, " n"]]:
    """The pose with the best vote, and those who voted for it."""
    draw, order, inner = jax.random.split(key, 3)
    chosen = sample_indices(draw, pairs.valid, _SAMPLE, options.hypotheses)
    rays = [unit_rays(points.T) for points in (pairs.first, pairs.second)]
    essentials, usable = essential_candidates(rays[0][chosen], rays[1][chosen])
    essentials = essentials.reshape(-1, 3, 3)
    essentials = _best(essentials, usable.reshape(-1), _drawn(pairs, order, options.pretest), options.finalists)
    essentials = _best(essentials, jnp.ones(len(essentials), bool), pairs, options.refined)
    poses = jax.vmap(lambda essential: _refined(decompose(essential), pairs, options.steps))(essentials)
    pose = _elected(poses, pairs, 1)
    rounds = jax.random.split(inner, options.rounds)
    pose, _ = lax.scan(lambda pose, key: (_improved(pose, pairs, key, options.subsets), None), pose, rounds)
    pose = jax.tree.map(lambda leaf: leaf[0], pose)
    inliers = _inliers(pose, pairs)
    return facing(pose, pairs.first.T, pairs.second.T, inliers.astype(pairs.sigma.dtype)), inliers


def _improved(pose: RelativePose, pairs: _Pairs, key: Key[Array, ""], count: int) -> RelativePose:
    """Local optimization: subsets of the inliers refine the pose each in its own way, and all vote again.

    A wrong pair among the inliers holds a pose in a local minimum of the vote, or of any robust kernel; most small
    subsets are free of it.

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
        return _refined(best, some, 3)

    poses = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), pose, jax.vmap(refit)(chosen))
    poses = _elected(poses, pairs, 2)
    refined = jax.vmap(lambda pose: _refined(pose, pairs, 3))(poses)
    return _elected(jax.tree.map(lambda *leaves: jnp.concatenate(leaves), poses, refined), pairs, 1)


def _elected(poses: RelativePose, pairs: _Pairs, count: int) -> RelativePose:
    """Some of the poses: those with the best votes."""
    costs = _votes(jax.vmap(lambda pose: pose.essential())(poses), pairs)
    _, index = lax.top_k(-costs, count)
    return jax.tree.map(lambda leaf: leaf[index], poses)


def _drawn(pairs: _Pairs, key: Key[Array, ""], count: int) -> _Pairs:
    """Some of the correspondences, at random, valid ones first."""
    luck = jax.random.uniform(key, pairs.valid.shape)
    index: Int[Array, " m"] = jnp.argsort(jnp.where(pairs.valid, luck, 2.0))[:count]
    return _Pairs(pairs.first[:, index], pairs.second[:, index], pairs.sigma, pairs.valid[index])


def _best(essentials: Float[Array, "k 3 3"], usable: Bool[Array, " k"], pairs: _Pairs, count: int) -> Array:
    costs = jnp.where(usable, _votes(essentials, pairs), jnp.inf)
    _, index = lax.top_k(-costs, min(count, len(essentials)))
    return essentials[index]


def _votes(essentials: Float[Array, "k 3 3"], pairs: _Pairs) -> Float[Array, " k"]:
    """Sum over correspondences of squared Sampson distances, cut off: matrix products for all hypotheses at once."""
    k = len(essentials)
    x1, x2 = pairs.first, pairs.second
    rays = (x1[:, None] * x2[None]).reshape(9, -1)
    error = matmul(essentials.reshape(k, 9), rays)
    lines = [matmul(essentials[:, i, :], x2) for i in (0, 1)] + [matmul(essentials[:, :, i], x1) for i in (0, 1)]
    squared = sum(line * line for line in lines) * (_GATE * pairs.sigma) ** 2
    ratio = error * error / jnp.where(squared > 0, squared, 1.0)
    cost = jnp.where(squared > 0, jnp.minimum(ratio, 1.0), 1.0)
    return jnp.sum(jnp.where(pairs.valid[None, :], cost, 0.0), axis=1)


def _refined(pose: RelativePose, pairs: _Pairs, steps: int) -> RelativePose:
    """Reweighted Gauss-Newton steps: squared Sampson distances of those within a gate that narrows."""
    zero = jnp.zeros(5, pairs.first.dtype)

    def step(pose: RelativePose, width: Array) -> tuple[RelativePose, None]:
        def whitened(delta: Array) -> Array:
            return sampson_components(retract(pose, delta).essential(), pairs.first, pairs.second) / pairs.sigma

        residual, push = jax.linearize(whitened, zero)
        jacobian = jax.vmap(push)(jnp.eye(5, dtype=zero.dtype))
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


def _judged(fit: Estimate, pairs: _Pairs, before: Bool[Array, " n"], hypotheses: int) -> Estimate:
    """Believed if more points agree than by chance, enough was tried, and a rotation alone does not explain them."""
    pose = lax.stop_gradient(fit.value)
    inliers = _inliers(pose, pairs)
    count, number = (jnp.sum(mask).astype(pairs.sigma.dtype) for mask in (inliers, pairs.valid))
    points = jnp.where(pairs.valid[None, :], pairs.first[:2], 0.0)
    mean = jnp.sum(points, axis=1, keepdims=True) / jnp.maximum(number, 1.0)
    spread = jnp.sum(jnp.where(pairs.valid[None, :], (points - mean) ** 2, 0.0)) / jnp.maximum(2.0 * number, 1.0)
    # The share of the image that lies in the band about an epipolar line: what agrees by chance.
    chance = 2.0 * _GATE * pairs.sigma / jnp.sqrt(jnp.maximum(6.0 * spread, pairs.sigma**2))
    enough = count > 2.0 * _SAMPLE + 6.0 * jnp.minimum(chance, 1.0) * number
    # By the same count: a translation that nothing but false pairs and noise suggests is none.
    apart = jnp.sum(inliers & _unturned(pairs, inliers)).astype(count.dtype)
    moved = apart > 2.0 * _SAMPLE + (6.0 * jnp.minimum(chance, 1.0) + 0.02) * number
    faces = _ahead(pose, pairs, inliers) > 0.5 * count
    # With so few of them right, would so many samples have held one without a wrong pair?
    share = jnp.clip(count / jnp.maximum(number, 1.0) - chance, 0.0, 1.0)
    searched = (1.0 - share**_SAMPLE) ** hypotheses < _DOUBT
    ok = fit.ok & enough & searched & (jnp.sum(before) > _SAMPLE)
    status = jnp.where(moved & faces, fit.status, int(Status.RANK_DEFICIENT))
    status = jnp.where(ok | ~fit.ok, status, int(Status.INADMISSIBLE))
    ok = ok & moved & faces
    cut = lambda leaf: jnp.where(ok, leaf, lax.stop_gradient(leaf))  # noqa: E731
    value, covariance = jax.tree.map(cut, fit.value), cut(fit.covariance)
    return eqx.tree_at(lambda e: (e.value, e.covariance, e.ok, e.status), fit, (value, covariance, ok, status))


def _unturned(pairs: _Pairs, inliers: Bool[Array, " n"]) -> Bool[Array, " n"]:
    """Which pairs the best rotation, found by reweighting, leaves further apart than noise does (99 %)."""
    rays = [unit_rays(points.T) for points in (pairs.first, pairs.second)]

    def left(rotation: Array) -> Float[Array, " n"]:
        error = transfer_error(rotation, pairs.second[:2], pairs.first[:2], pairs.sigma, inliers)
        return jnp.sqrt(jnp.sum(error**2, axis=0))

    def turn(weights: Array, width: Array) -> tuple[Array, Array]:
        rotation = align_points(rays[1], rays[0], weights=weights, valid=inliers).value.rotation.matrix()
        return jnp.maximum(1.0 - (left(rotation) / width) ** 2, 0.0) ** 2, rotation

    widths = jnp.geomspace(_FAR, 4.685, 8, dtype=pairs.sigma.dtype)
    _, rotations = lax.scan(turn, jnp.ones_like(rays[0][:, 0]), widths)
    return left(rotations[-1]) > 3.03


def _ahead(pose: RelativePose, pairs: _Pairs, inliers: Bool[Array, " n"]) -> Float[Array, ""]:
    """How many inliers lie ahead of both cameras."""
    turned = matmul(pose.rotation.matrix(), pairs.second)
    signs = depth_signs(pose.direction.vector, pairs.first.T, turned.T)
    return jnp.sum(inliers & jnp.all(signs > 0, axis=0)).astype(signs.dtype)
