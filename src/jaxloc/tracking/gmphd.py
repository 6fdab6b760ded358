"""Gaussian mixture PHD filter: the intensity of targets (their expected number in any region) as a sum of normals.

It has no data association: every component is updated by every measurement, and the weights decide. Covariances and
gains are computed once per component, weights once per pair, and states only for the pairs heavy enough to be kept.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from jaxloc import _tree as tree
from jaxloc.beliefs import Closeness, MahalanobisDistance, Mixture
from jaxloc.filters import FilterState
from jaxloc.filters.interface import conclude
from jaxloc.tracking import intensity
from jaxloc.tracking.gating import at_least_one
from jaxloc.tracking.intensity import Spawning
from jaxloc.tracking.interface import Targets, Tracker, TrackerInfo
from jaxloc.tracking.models.target import TargetModel


class PhdState(FilterState):
    """State of the PHD filter.

    Attributes:
        mixture: the intensity; the label of a component is the number of its track.
        step: number of predictions so far.
        num_labels: number of labels given so far.
        clutter_scale: clutter rate over that of the model, where it is estimated.
    """

    mixture: Mixture
    step: Int[Array, ""]
    num_labels: Int[Array, ""]
    clutter_scale: Float[Array, ""]


class GmPhd(Tracker):
    """The Gaussian mixture probability hypothesis density (PHD) filter.

    Args:
        model: motion, detection, clutter and births of targets.
        capacity: components that are kept.
        candidates: components that take part in merging: the heaviest after the update. None for twice the capacity.
        prune: weight below which a component is dropped.
        closeness: which components are merged.
        gate: probability that a target's own measurement passes; None for no gate.
        spawning: targets that split off others.
        extraction: weight above which a component is a target.
        copies: whether a component of weight w stands for ``round(w)`` targets in the same place, as in Vo and Ma's
            table III (they share a label); else for one.
        clutter_memory: scans over which the clutter rate is averaged; 0 keeps the model's.

    References:
        Vo and Ma, "The Gaussian mixture probability hypothesis density filter", IEEE TSP 2006 [T-63], [T-75]; Clark,
        Panta and Vo, "The GM-PHD filter multiple target tracker", 2006 (labels) [T-82].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> motion, sensor = jl.filters.ConstantVelocity(1.0), jl.filters.LinearSensor(jnp.eye(2, 4), jnp.eye(2))
        >>> model = jl.tracking.TargetModel(
        ...     jl.filters.KalmanFilter(motion, sensor),
        ...     detection=0.9,
        ...     survival=0.99,
        ...     clutter=jl.tracking.UniformClutter(5.0, 1e4),
        ...     birth=jl.tracking.PointBirth(0.1, 1e4, jnp.eye(2), jnp.ones(2)),
        ... )
        >>> phd = jl.tracking.GmPhd(model, capacity=20)
        >>> state = phd.init(jl.beliefs.Mixture.empty(1, jnp.zeros(4)))
        >>> seen = jnp.array([[10.0, 20.0], [50.0, 60.0], [0.0, 0.0]])
        >>> scans, valid = jnp.stack([seen] * 3), jnp.array([[True, True, False]] * 3)
        >>> state, history = jl.filters.run(phd, state, jnp.ones(3), scans, valid)
        >>> targets = phd.extract(state)
        >>> int(targets.valid.sum()), round(float(history.infos.count[-1]))
        (2, 2)
    """

    model: TargetModel
    capacity: int = eqx.field(static=True, default=100)
    candidates: int | None = eqx.field(static=True, default=None)
    prune: float = eqx.field(static=True, default=1e-5)
    closeness: Closeness = eqx.field(default_factory=MahalanobisDistance)
    gate: float | None = eqx.field(static=True, default=None)
    spawning: Spawning | None = None
    extraction: float = eqx.field(static=True, default=0.5)
    copies: bool = eqx.field(static=True, default=False)
    clutter_memory: float = eqx.field(static=True, default=0.0)

    def init(self, prior: Mixture) -> PhdState:
        """The state of a prior intensity; ``Mixture.empty(1, example)`` for no targets yet."""
        if prior.capacity > self.capacity:
            raise ValueError(f"GmPhd keeps {self.capacity} components; the prior has {prior.capacity}. Reduce it.")
        one = jnp.ones((), prior.weights.dtype)
        return PhdState(
            prior.check().usable().padded(self.capacity), jnp.zeros((), jnp.int32), jnp.max(prior.labels) + 1, one
        )

    def predict(self, state: PhdState, control: Any, *, key: Key[Array, ""] | None = None) -> PhdState:
        """Survivors move, others appear."""
        del key
        first = state.num_labels
        mixture = intensity.predict(state.mixture, self.model, control, first_label=first, spawning=self.spawning)
        born = mixture.capacity - state.mixture.capacity
        return PhdState(mixture, state.step + 1, first + born, state.clutter_scale)

    def update(
        self, state: PhdState, measurement: Any, valid: Bool[Array, " m"], *, key: Key[Array, ""] | None = None
    ) -> tuple[PhdState, TrackerInfo]:
        """``D = (1 - p_D) D- + sum_z sum_j w_j(z) N(m_j(z), P_j)``, reduced to the capacity.

        Where the scan cannot be used, the state is the predicted one, reduced to the capacity.
        """
        del key
        measurement, valid = at_least_one(measurement, valid)
        ok, (after, info) = tree.protect(GmPhd._updated, self, state, measurement, valid)
        held = PhdState(
            intensity.predicted_only(state.mixture, self.capacity), state.step, after.num_labels, state.clutter_scale
        )
        return conclude(ok, after, info, held)

    def _updated(
        self, state: PhdState, measurement: Any, valid: Bool[Array, " m"]
    ) -> tuple[Bool[Array, ""], tuple[PhdState, TrackerInfo]]:
        scale = state.clutter_scale
        evidence = intensity.weigh(state.mixture, measurement, valid, self.model, gate=self.gate, clutter_scale=scale)
        reduced, crowded = self.reduced(state.mixture, measurement, evidence, state.num_labels)
        first = state.num_labels + valid.shape[0]
        reduced = intensity.make_labels_unique(reduced, reduced.weights > self.extraction, first)
        if self.clutter_memory > 0.0:
            share = 1.0 / self.clutter_memory
            seen = jnp.sum(jnp.where(evidence.valid, evidence.clutter, 0.0)) / self.model.clutter.rate
            scale = (1.0 - share) * scale + share * seen
        after = PhdState(reduced, state.step, first + self.capacity, scale)
        ok = tree.all_finite((after, evidence.log_likelihood)) & self.model.usable & jnp.any(evidence.comparison.usable)
        info = TrackerInfo(jnp.where(ok, evidence.log_likelihood, 0.0), ok, reduced.mass, crowded)
        return ok, (after, info)

    def reduced(
        self, mixture: Mixture, measurement: Any, evidence: intensity.Evidence, first_label: Any
    ) -> tuple[Mixture, Int[Array, ""]]:
        """The intensity after a scan, and how many components were dropped for lack of room.

        Args:
            mixture: the intensity before the scan.
            measurement: the scan.
            evidence: weights of all components.
            first_label: label of a component born with the first measurement; those of the others follow.
        """
        candidates = 2 * self.capacity if self.candidates is None else self.candidates
        chosen = intensity.heaviest(
            mixture, measurement, evidence, self.model.birth, candidates=candidates, first_label=first_label
        )
        return intensity.reduce(chosen, evidence, self.capacity, prune=self.prune, closeness=self.closeness)

    def extract(self, state: PhdState) -> Targets:
        """Components heavier than the threshold."""
        mixture = state.mixture
        chosen = mixture.weights > self.extraction
        counts = jnp.maximum(jnp.round(mixture.weights), 1.0) if self.copies else jnp.ones_like(mixture.weights)
        ends = jnp.cumsum(jnp.where(chosen, counts, 0.0))
        slots = jnp.arange(mixture.capacity)
        rows = jnp.sum(ends[None, :] <= slots[:, None].astype(ends.dtype), axis=1)
        filled = slots.astype(ends.dtype) < ends[-1]
        kept = mixture.take(jnp.where(filled, rows, 0))
        return Targets(kept.means, kept.covariances, kept.weights, kept.labels, filled)
