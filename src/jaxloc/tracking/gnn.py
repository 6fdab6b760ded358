"""Global nearest neighbor (GNN) tracker: one optimal assignment of measurements to tracks per scan."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxloc import _tree as tree
from jaxloc.solvers.assignment import assign
from jaxloc.tracking.interface import Tracker, TrackerInfo
from jaxloc.tracking.likelihood_ratio import compare_scan, correct_tracks
from jaxloc.tracking.tracks import Tracks, TrackTable, age_tracks, manage_tracks

_LARGEST = 60.0  # log odds, beyond which existence is certain to rounding


class GlobalNearestNeighbor(TrackTable, Tracker):
    """Tracker by the most probable one-to-one assignment of each scan; unassigned tracks count as missed.

    A pair costs ``-log r p_D N(z; ...) / (kappa(z) + b(z))``, a track without a measurement ``-log (1 - r p_D)``. The
    existence of a track is that of integrated data association with its assigned measurement. Unassigned measurements
    initiate new tracks.

    Args:
        model: the target model; its filter may be an `InteractingMultipleModel`.
        capacity: number of slots for tracks, tentative ones included.
        gate: probability that a track's own measurement passes; None for no gate.
        logic: when tracks are confirmed and deleted.

    References:
        Blackman and Popoli, *Design and Analysis of Modern Tracking Systems*, 1999, chapter 6 [T-58].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> sensor = jl.filters.LinearSensor(jnp.eye(2, 4), jnp.eye(2))
        >>> filt = jl.filters.KalmanFilter(jl.filters.ConstantVelocity(0.1, axes=2), sensor)
        >>> birth = jl.tracking.PointBirth(0.1, 1e4, jnp.eye(2), jnp.ones(2))
        >>> clutter = jl.tracking.UniformClutter(0.1, 1e4)
        >>> model = jl.tracking.TargetModel(filt, detection=0.9, survival=0.99, clutter=clutter, birth=birth)
        >>> tracker = jl.tracking.GlobalNearestNeighbor(model, capacity=8)
        >>> state = tracker.init(jl.beliefs.Mixture.empty(1, jnp.zeros(4)))
        >>> places = jnp.array([[[0.0, 0.0], [30.0, 0.0]]]) + jnp.arange(4.0)[:, None, None]
        >>> state, _ = jl.filters.run(tracker, state, jnp.ones(4), places, jnp.ones((4, 2), bool))
        >>> found = tracker.extract(state)
        >>> found.means[found.valid, 0].round().tolist(), found.labels[found.valid].tolist()
        ([3.0, 33.0], [0, 1])
    """

    def associate_scan(self, state: Tracks, measurement: Any, valid: Bool[Array, " m"]) -> tuple[Tracks, TrackerInfo]:
        """The tracks given a scan; the likelihood is that of the chosen assignment."""
        scan = compare_scan(self.model, state, measurement, valid, self.gate)
        pairs = jnp.isfinite(scan.log_odds)
        found = assign(-scan.log_odds, pairs, unassigned=-scan.log_missed)
        hit, column = found.columns >= 0, jnp.maximum(found.columns, 0)
        rows = jnp.arange(state.capacity)
        moved = correct_tracks(self.model, state, scan, rows, column)
        states = jax.vmap(tree.where)(hit, moved, state.states)
        existence = _existence(state.existence, scan.detection, jnp.where(hit, scan.log_odds[rows, column], -jnp.inf))
        aged = age_tracks(state, states, existence, hit)
        taken = jnp.zeros(scan.valid.shape, bool).at[column].max(hit)
        newborn = jnp.where(taken, 0.0, scan.share)
        after, crowded = manage_tracks(aged, scan.newborn.states, newborn, self.logic)
        likelihood = scan.base - found.cost
        ok = tree.all_finite((after, likelihood)) & scan.usable
        info = TrackerInfo(jnp.where(ok, likelihood, 0.0), ok, jnp.sum(after.existence), crowded)
        return after, info


def _existence(
    existence: Float[Array, " k"], detection: Float[Array, " k"], log_odds: Float[Array, " k"]
) -> Float[Array, " k"]:
    """Existence given the measurement that a track took, or none: ``1 - (1 - r) / (1 - r p_D + r p_D N / lambda)``."""
    taken = jnp.isfinite(log_odds)
    odds = jnp.where(taken, jnp.exp(jnp.minimum(jnp.where(taken, log_odds, 0.0), _LARGEST)), 0.0)
    total = 1.0 - existence * detection + odds
    return 1.0 - (1.0 - existence) / jnp.where(total > 0.0, total, 1.0)
