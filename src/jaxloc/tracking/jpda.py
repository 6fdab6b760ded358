"""Joint probabilistic data association (JPDA): as PDA, but two tracks never share a measurement."""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxloc._linalg import matmul
from jaxloc.tracking.interface import Tracker, TrackerInfo
from jaxloc.tracking.likelihood_ratio import compare_scan
from jaxloc.tracking.pda import Association, require_gaussian, scaled_weights, update_tracks
from jaxloc.tracking.tracks import Tracks, TrackTable

_LARGEST_EXACT = 14  # bits of a set: 16384 sums a step


class Marginals(eqx.Module):
    """How association probabilities are computed from weights ``w_ij`` of pairs and ``w_i0`` of missed detections."""

    @abstractmethod
    def associate(self, log_odds: Float[Array, "k m"], log_missed: Float[Array, " k"]) -> Association:
        """Marginal association probabilities over all one-to-one associations.

        Args:
            log_odds: ``log w_ij``; minus infinity where a pair is impossible.
            log_missed: ``log w_i0``.
        """


class Exact(Marginals):
    """Exact marginals, by a recursion over the longer side that sums over each subset of the shorter side.

    Time and memory double with each element of the shorter side, which may have 14.

    References:
        Fortmann, Bar-Shalom and Scheffe, "Sonar tracking of multiple targets using joint probabilistic data
        association", IEEE JOE 1983 [T-60].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> found = jl.tracking.Exact().associate(jnp.zeros((2, 1)), jnp.zeros(2))
        >>> round(float(found.pairs[0, 0]), 3), round(float(found.missed[0]), 3)
        (0.333, 0.667)
    """

    def associate(self, log_odds: Float[Array, "k m"], log_missed: Float[Array, " k"]) -> Association:
        """The probability of a pair is the derivative of the log normalizer by the log of its weight."""
        weights, missed, scales = scaled_weights(log_odds, log_missed)
        if min(weights.shape) > _LARGEST_EXACT:
            raise ValueError(
                f"Exact works up to {_LARGEST_EXACT} tracks or measurements, whichever are fewer; got "
                f"{weights.shape[0]} and {weights.shape[1]}. Use BeliefPropagation."
            )

        ratios = weights / missed[:, None]
        # Few measurements: sets of them, track by track. Few tracks: sets of tracks, measurement by measurement.
        table = ratios if ratios.shape[1] <= ratios.shape[0] else ratios.T
        log_sum, slopes = jax.value_and_grad(_log_matchings)(table)
        slopes = slopes if ratios.shape[1] <= ratios.shape[0] else slopes.T
        pairs = jnp.minimum(ratios * slopes, 1.0)
        rest = jnp.maximum(1.0 - jnp.sum(pairs, axis=1), 0.0)
        return Association(pairs, rest, log_sum + jnp.sum(jnp.log(missed) + scales))


class BeliefPropagation(Marginals):
    """Loopy belief propagation between tracks and measurements: close to exact, at the cost of PDA.

    The normalizer is the Bethe approximation.

    Args:
        iterations: number of message rounds.

    References:
        Williams and Lau, "Approximate evaluation of marginal association probabilities with belief propagation", IEEE
        TAES 2014 [T-60].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> found = jl.tracking.BeliefPropagation().associate(jnp.zeros((2, 1)), jnp.zeros(2))
        >>> round(float(found.pairs[0, 0]), 3)
        0.333
    """

    iterations: int = eqx.field(static=True, default=20)

    def associate(self, log_odds: Float[Array, "k m"], log_missed: Float[Array, " k"]) -> Association:
        """Messages of tracks are ``w_ij / (w_i0 + sum_l w_il nu_li)``, those of measurements ``1 / (1 + sum mu)``."""
        weights, missed, scales = scaled_weights(log_odds, log_missed)
        tiny = float(jnp.finfo(weights.dtype).tiny)

        def to_measurements(backward):
            parts = weights * backward
            others = jnp.maximum(jnp.sum(parts, axis=1)[:, None] - parts, 0.0) + missed[:, None]
            return weights / jnp.maximum(others, tiny)

        def to_tracks(forward):
            return 1.0 / (1.0 + jnp.maximum(jnp.sum(forward, axis=0)[None, :] - forward, 0.0))

        def turn(backward, _):
            return to_tracks(to_measurements(backward)), None

        backward, _ = lax.scan(turn, jnp.ones_like(weights), None, length=self.iterations)
        forward = to_measurements(backward)
        totals = missed + jnp.sum(weights * backward, axis=1)
        pairs = weights * backward / totals[:, None]
        bethe = jnp.sum(jnp.log(totals) + scales) + jnp.sum(jnp.log1p(jnp.sum(forward, axis=0)))
        bethe = bethe - jnp.sum(jnp.log1p(forward * backward))
        return Association(pairs, missed / totals, bethe)


class JointProbabilisticDataAssociation(TrackTable, Tracker):
    """Joint integrated PDA tracker: each measurement comes from at most one track (JIPDA).

    As in `ProbabilisticDataAssociation`, each track becomes the normal density with the moments of its mixture over
    measurements, and its existence probability is updated.

    Args:
        model: the target model, with a filter of the Kalman family.
        capacity: number of slots for tracks, tentative ones included.
        gate: probability that a track's own measurement passes; None for no gate.
        logic: when tracks are confirmed and deleted.
        marginals: how association probabilities are computed, `BeliefPropagation` or `Exact`.

    Raises:
        TypeError: if the filter of the model is not of the Kalman family.

    References:
        Musicki and Evans, "Joint integrated probabilistic data association: JIPDA", IEEE TAES 2004 [T-60].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> sensor = jl.filters.LinearSensor(jnp.eye(2, 4), jnp.eye(2))
        >>> filt = jl.filters.KalmanFilter(jl.filters.ConstantVelocity(0.1, axes=2), sensor)
        >>> birth = jl.tracking.PointBirth(0.1, 1e4, jnp.eye(2), jnp.ones(2))
        >>> clutter = jl.tracking.UniformClutter(0.1, 1e4)
        >>> model = jl.tracking.TargetModel(filt, detection=0.9, survival=0.99, clutter=clutter, birth=birth)
        >>> tracker = jl.tracking.JointProbabilisticDataAssociation(model, capacity=8)
        >>> state = tracker.init(jl.beliefs.Mixture.empty(1, jnp.zeros(4)))
        >>> places = jnp.stack([jnp.zeros((4, 2)), jnp.full((4, 2), 9.0)], axis=1)
        >>> state, _ = jl.filters.run(tracker, state, jnp.ones(4), places, jnp.ones((4, 2), bool))
        >>> int(tracker.extract(state).valid.sum())
        2
    """

    marginals: Marginals = eqx.field(default_factory=BeliefPropagation)

    def __check_init__(self):
        require_gaussian(self.model, "JointProbabilisticDataAssociation")

    def associate_scan(self, state: Tracks, measurement: Any, valid: Bool[Array, " m"]) -> tuple[Tracks, TrackerInfo]:
        """The tracks given a scan."""
        scan = compare_scan(self.model, state, measurement, valid, self.gate)
        return update_tracks(state, scan, self.marginals.associate(scan.log_odds, scan.log_missed), self.logic)


def _log_matchings(table: Float[Array, "r c"]) -> Float[Array, ""]:
    """Log of the sum over all one-to-one matchings of the products of their entries; subsets are bit masks."""
    columns = table.shape[1]
    sets = jnp.arange(1 << columns)
    bits = jnp.arange(columns)
    holds = (sets[:, None] >> bits[None, :]) & 1 == 1
    without = sets[:, None] & ~(1 << bits[None, :])

    def add(carry, row):
        sums, scale = carry
        more = jnp.where(holds, sums[without], 0.0)
        sums = sums + matmul(more, row)
        largest = lax.stop_gradient(jnp.max(sums))
        return (sums / largest, scale + jnp.log(largest)), None

    empty = jnp.zeros(1 << columns, table.dtype).at[0].set(1.0)
    (sums, scale), _ = lax.scan(add, (empty, jnp.zeros((), table.dtype)), table)
    return jnp.log(jnp.sum(sums)) + scale
