"""Probabilistic data association (PDA): each track is updated by all gated measurements, weighted by probability."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxloc import _tree as tree
from jaxloc.beliefs.square_root import cholesky, product, triangularize
from jaxloc.filters import GaussianFilter, GaussianState
from jaxloc.filters.kalman import retract_root
from jaxloc.tracking.gating import Comparison
from jaxloc.tracking.interface import Tracker, TrackerInfo
from jaxloc.tracking.likelihood_ratio import Scan, compare_scan
from jaxloc.tracking.models.target import TargetModel
from jaxloc.tracking.tracks import TrackLogic, Tracks, TrackTable, age_tracks, manage_tracks, miss


class Association(eqx.Module):
    """Association probabilities of tracks and measurements.

    Attributes:
        pairs: beta, probability that a track (row) gave a measurement (column).
        missed: probability that a track has no measurement: the rest of its row.
        log_normalizer: log of the sum over all joint associations of their weights.
    """

    pairs: Float[Array, "k m"]
    missed: Float[Array, " k"]
    log_normalizer: Float[Array, ""]


class ProbabilisticDataAssociation(TrackTable, Tracker):
    """Integrated PDA tracker: tracks are independent, gated measurements are the track's own or clutter (IPDA).

    The state of a track becomes the normal density with the moments of its mixture over measurements, and its existence
    probability is updated. Close tracks share measurements: they may coalesce, and duplicate tracks of one target
    persist. `JointProbabilisticDataAssociation` costs little more.

    Args:
        model: the target model, with a filter of the Kalman family.
        capacity: number of slots for tracks, tentative ones included.
        gate: probability that a track's own measurement passes; None for no gate.
        logic: when tracks are confirmed and deleted.

    Raises:
        TypeError: if the filter of the model is not of the Kalman family.

    References:
        Bar-Shalom and Tse, "Tracking in a cluttered environment with probabilistic data association", Automatica 1975;
        Musicki, Evans and Stankovic, "Integrated probabilistic data association", IEEE TAC 1994 [T-59].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> sensor = jl.filters.LinearSensor(jnp.eye(2, 4), jnp.eye(2))
        >>> filt = jl.filters.KalmanFilter(jl.filters.ConstantVelocity(0.1, axes=2), sensor)
        >>> birth = jl.tracking.PointBirth(0.1, 1e4, jnp.eye(2), jnp.ones(2))
        >>> clutter = jl.tracking.UniformClutter(0.1, 1e4)
        >>> model = jl.tracking.TargetModel(filt, detection=0.9, survival=0.99, clutter=clutter, birth=birth)
        >>> tracker = jl.tracking.ProbabilisticDataAssociation(model, capacity=8)
        >>> state = tracker.init(jl.beliefs.Mixture.empty(1, jnp.zeros(4)))
        >>> state, _ = jl.filters.run(tracker, state, jnp.ones(4), jnp.ones((4, 1, 2)), jnp.ones((4, 1), bool))
        >>> int(tracker.extract(state).valid.sum())
        1
    """

    def __check_init__(self):
        require_gaussian(self.model, "ProbabilisticDataAssociation")

    def associate_scan(self, state: Tracks, measurement: Any, valid: Bool[Array, " m"]) -> tuple[Tracks, TrackerInfo]:
        """The tracks given a scan."""
        scan = compare_scan(self.model, state, measurement, valid, self.gate)
        return update_tracks(state, scan, associate_alone(scan.log_odds, scan.log_missed), self.logic)


def require_gaussian(model: TargetModel, name: str) -> None:
    """Raises a `TypeError` when the filter of a model has no single normal density."""
    if isinstance(model, TargetModel) and not isinstance(model.filter, GaussianFilter):
        raise TypeError(
            f"{name} needs a model with a filter of the Kalman family; got {type(model.filter).__name__}. "
            "GlobalNearestNeighbor takes InteractingMultipleModel."
        )


def associate_alone(log_odds: Float[Array, "k m"], log_missed: Float[Array, " k"]) -> Association:
    """Association probabilities of each track as if it were the only one: ``beta_ij = w_ij / (w_i0 + sum_l w_il)``.

    Args:
        log_odds: ``log w_ij`` of the pairs; minus infinity where they are impossible.
        log_missed: ``log w_i0``.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> found = jl.tracking.pda.associate_alone(jnp.log(jnp.array([[3.0, 1.0]])), jnp.zeros(1))
        >>> bool(jnp.allclose(found.pairs, jnp.array([[0.6, 0.2]]))), round(float(found.missed[0]), 3)
        (True, 0.2)
    """
    weights, missed, scales = scaled_weights(log_odds, log_missed)
    total = missed + jnp.sum(weights, axis=1)
    normalizer = jnp.sum(jnp.log(total) + scales)
    return Association(weights / total[:, None], missed / total, normalizer)


def scaled_weights(
    log_odds: Float[Array, "k m"], log_missed: Float[Array, " k"]
) -> tuple[Float[Array, "k m"], Float[Array, " k"], Float[Array, " k"]]:
    """Weights of pairs and of missed detections over the largest of each track, and the log of the largest."""
    possible = jnp.isfinite(log_odds)
    safe = jnp.where(possible, log_odds, 0.0)
    largest = jnp.max(jnp.where(possible, safe, -jnp.inf), axis=1, initial=-jnp.inf)
    scales = jax.lax.stop_gradient(jnp.maximum(largest, log_missed))
    weights = jnp.where(possible, jnp.exp(jnp.where(possible, safe - scales[:, None], 0.0)), 0.0)
    # Several tracks may all favor one measurement by far: a missed detection must stay possible.
    least = float(jnp.finfo(weights.dtype).eps) ** 2
    return weights, jnp.maximum(jnp.exp(log_missed - scales), least), scales


def update_tracks(state: Tracks, scan: Scan, found: Association, logic: TrackLogic) -> tuple[Tracks, TrackerInfo]:
    """The tracks after a scan, given association probabilities; unexplained measurements initiate new tracks."""
    left = miss(state.existence, scan.detection)
    hit = 1.0 - found.missed
    existence = hit + found.missed * left
    # The derivative by an existence of nearly zero overflows; such tracks are deleted.
    divisor = jnp.where(existence > 1.0 / tree.largest(existence.dtype), existence, 1.0)
    moved = match_moments(state.states, scan.comparison, found.pairs / divisor[:, None])
    states = jax.vmap(tree.where)(jnp.any(found.pairs > 0.0, axis=1), moved, state.states)
    aged = age_tracks(state, states, existence, hit > 0.5)
    unexplained = 1.0 - jnp.sum(found.pairs, axis=0)
    newborn = jnp.where(unexplained > 0.5, unexplained * scan.share, 0.0)
    after, crowded = manage_tracks(aged, scan.newborn.states, newborn, logic)
    likelihood = scan.base + found.log_normalizer
    ok = tree.all_finite((after, likelihood)) & scan.usable
    return after, TrackerInfo(jnp.where(ok, likelihood, 0.0), ok, jnp.sum(after.existence), crowded)


def match_moments(states: GaussianState, comparison: Comparison, weights: Float[Array, "k m"]) -> GaussianState:
    """The normal density with the moments of each track's mixture over its measurements and the missed detection.

    With the root ``[[V, 0], [G, S]]`` of (measurement, state) and whitened innovations ``e_j``: the mean moves by
    ``G sum_j beta_j e_j``, and ``P = S S^T + G (beta_0 I + cov e) G^T``. Everything added is positive, and none of the
    densities of the mixture is formed.

    Args:
        states: predicted, stacked.
        comparison: of them with the measurements.
        weights: beta of each pair, given that the target exists.

    References:
        Bar-Shalom and Li, *Multitarget-Multisensor Tracking*, 1995, section 3.4 [T-59].
    """

    def one(state, root, residuals, beta):
        size = residuals.shape[-1]
        none = jnp.maximum(1.0 - jnp.sum(beta), 0.0)
        shift = jnp.sum(beta[:, None] * residuals, axis=0)
        deviations = jnp.sqrt(_positive(beta))[:, None] * (residuals - shift[None, :])
        deviations = jnp.where(beta[:, None] > 0.0, deviations, 0.0)
        missed = none * (jnp.eye(size, dtype=root.dtype) + shift[:, None] * shift[None, :])
        middle = cholesky(missed + jnp.sum(deviations[:, :, None] * deviations[:, None, :], axis=0))
        gain, rest = root[size:, :size], root[size:, size:]
        both = triangularize(jnp.concatenate([rest, product(gain, middle)], axis=1))
        mean, both = retract_root(state.mean, product(gain, shift), both)
        return GaussianState(mean, both, state.step)

    return jax.vmap(one)(states, comparison.roots, comparison.residuals, weights)


def _positive(values: Float[Array, " m"]) -> Float[Array, " m"]:
    return jnp.where(values > 0.0, values, 1.0)
