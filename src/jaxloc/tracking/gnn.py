"""Global nearest neighbor: each track takes at most one measurement, by the one best assignment."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from jaxloc.beliefs import Mixture
from jaxloc.filters.kalman import select
from jaxloc.solvers.assignment import assign
from jaxloc.tracking.interface import Targets, Tracker, TrackerInfo
from jaxloc.tracking.likelihood_ratio import correct_tracks, examine, whole
from jaxloc.tracking.models.target import TargetModel
from jaxloc.tracking.tracks import (
    ExistenceLife,
    Life,
    Tracks,
    age_tracks,
    extract_tracks,
    open_tracks,
    predict_tracks,
    renew,
)

_LARGEST = 60.0  # log odds, beyond which existence is certain to rounding


class GlobalNearestNeighbor(Tracker):
    """One assignment a scan, the most probable one: tracks that take a measurement believe it, the others were missed.

    A pair costs ``-log r p_D N(z; ...) / (kappa(z) + b(z))``, a track without a measurement ``-log (1 - r p_D)``. The
    existence of a track is that of integrated data association with the measurement it was given. Measurements that no
    track takes begin new ones.

    Args:
        model: what targets do, and what is seen of them; its filter may be an `InteractingFilters`.
        capacity: how many tracks there is room for, tentative ones included.
        gate: probability that a track's own measurement passes; None for no gate.
        life: when tracks are confirmed and deleted.

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

    model: TargetModel
    capacity: int = eqx.field(static=True, default=100)
    gate: float | None = eqx.field(static=True, default=0.999)
    life: Life = eqx.field(default_factory=ExistenceLife)

    def init(self, prior: Mixture | None) -> Tracks:
        """Tracks of a prior, whose weights are probabilities; see `open_tracks`."""
        return open_tracks(self.model, self.capacity, prior, self.life)

    def predict(self, state: Tracks, control: Any, *, key: Key[Array, ""] | None = None) -> Tracks:
        """Every track one step later."""
        del key
        return predict_tracks(self.model, state, control)

    def update(
        self, state: Tracks, measurement: Any, valid: Bool[Array, " m"], *, key: Key[Array, ""] | None = None
    ) -> tuple[Tracks, TrackerInfo]:
        """The tracks given a scan; the likelihood is that of the chosen assignment."""
        del key
        scan = examine(self.model, state, measurement, valid, self.gate)
        pairs = jnp.isfinite(scan.log_odds)
        found = assign(-scan.log_odds, pairs, unassigned=-scan.log_missed)
        hit, column = found.columns >= 0, jnp.maximum(found.columns, 0)
        rows = jnp.arange(state.capacity)
        moved = correct_tracks(self.model, state, scan, rows, column)
        states = jax.vmap(select)(hit, moved, state.states)
        existence = _existence(state.existence, scan.detection, jnp.where(hit, scan.log_odds[rows, column], -jnp.inf))
        aged = age_tracks(state, states, existence, hit)
        taken = jnp.zeros(scan.there.shape, bool).at[column].max(hit)
        newborn = jnp.where(taken, 0.0, scan.share)
        after, crowded = renew(aged, scan.newborn.states, newborn, self.life)
        likelihood = scan.base - found.cost
        ok = whole(after, likelihood)
        after = select(ok, after, state)
        info = TrackerInfo(jnp.where(ok, likelihood, 0.0), ok, jnp.sum(after.existence), crowded)
        return after, info

    def extract(self, state: Tracks) -> Targets:
        """The confirmed tracks."""
        return extract_tracks(state, self.life)


def _existence(
    existence: Float[Array, " k"], detection: Float[Array, " k"], log_odds: Float[Array, " k"]
) -> Float[Array, " k"]:
    """Existence given the measurement that a track took, or none: ``1 - (1 - r) / (1 - r p_D + r p_D N / lambda)``."""
    taken = jnp.isfinite(log_odds)
    odds = jnp.where(taken, jnp.exp(jnp.minimum(jnp.where(taken, log_odds, 0.0), _LARGEST)), 0.0)
    total = 1.0 - existence * detection + odds
    return 1.0 - (1.0 - existence) / jnp.where(total > 0.0, total, 1.0)
