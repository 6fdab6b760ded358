"""The Gaussian mixture PHD filter: the expected number of targets anywhere, as a sum of normals.

It has no data association: every component is updated by every measurement, and the weights decide. Covariances and
gains are worked out once a component, weights once a pair, and states only for the pairs heavy enough to be kept.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy.special import logsumexp
from jaxtyping import Array, Bool, Float, Int, Key

from jaxloc._linalg import matmul
from jaxloc.beliefs import Closeness, MahalanobisDistance, Mixture, Motion, reduce_mixture
from jaxloc.filters import FilterState, GaussianState, History
from jaxloc.filters import run as run_filter
from jaxloc.filters.kalman import finite_or_zero, spread_motion
from jaxloc.poses.lie_group import as_floats
from jaxloc.tracking.gating import Comparison, compare, corrected, count_valid, with_room
from jaxloc.tracking.interface import Targets, Tracker, TrackerInfo
from jaxloc.tracking.models.birth import MeasuredBirth
from jaxloc.tracking.models.target import TargetModel


class Spawning(eqx.Module):
    """Targets that split off others.

    Args:
        weight: expected number that one target brings forth between two scans.
        motion: from the state of the parent to that of the child.

    References:
        Vo and Ma 2006, eq. 22 [T-75].
    """

    weight: Float[Array, ""]
    motion: Motion

    def __init__(self, weight: Any, motion: Motion):
        (self.weight,), self.motion = as_floats(weight), motion


class PhdState(FilterState):
    """What the next step of a PHD filter needs.

    Attributes:
        mixture: the intensity; the label of a component is the number of its track.
        step: how many predictions led here.
        num_labels: how many tracks have been numbered.
        clutter_scale: clutter rate over that of the model, where it is estimated.
    """

    mixture: Mixture
    step: Int[Array, ""]
    num_labels: Int[Array, ""]
    clutter_scale: Float[Array, ""]


class GmPhd(Tracker):
    """The PHD filter as a `Tracker`, and the options of its three steps.

    Args:
        model: what targets do, and what is measured of them.
        capacity: components that are kept.
        candidates: components that take part in merging: the heaviest after the update. None for twice the capacity.
        prune: weight below which a component is dropped.
        closeness: which components are merged.
        gate: probability that a target's own measurement passes; None for no gate.
        spawning: targets that split off others.
        extraction: weight above which a component is a target.
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
        >>> for _ in range(3):
        ...     state = phd.predict(state, jnp.array(1.0))
        ...     state, info = phd.update(state, seen, jnp.array([True, True, False]))
        >>> targets = phd.extract(state)
        >>> int(targets.valid.sum()), round(float(info.count))
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
    clutter_memory: float = eqx.field(static=True, default=0.0)

    def init(self, prior: Mixture) -> PhdState:
        """The state of a prior intensity, such as ``Mixture.empty(1, example)`` for nobody yet."""
        if prior.capacity > self.capacity:
            raise ValueError(f"GmPhd keeps {self.capacity} components; the prior has {prior.capacity}. Reduce it.")
        one = jnp.ones((), prior.weights.dtype)
        return PhdState(prior.check().padded(self.capacity), jnp.zeros((), jnp.int32), jnp.max(prior.labels) + 1, one)

    def predict(self, state: PhdState, control: Any, *, key: Key[Array, ""] | None = None) -> PhdState:
        """Survivors move, others appear."""
        del key
        mixture = predict(state.mixture, self, control, first_label=state.num_labels)
        born = mixture.capacity - state.mixture.capacity
        return PhdState(mixture, state.step + 1, state.num_labels + born, state.clutter_scale)

    def update(
        self, state: PhdState, measurement: Any, valid: Bool[Array, " m"], *, key: Key[Array, ""] | None = None
    ) -> tuple[PhdState, TrackerInfo]:
        """The intensity given a scan, reduced to the capacity."""
        del key
        measurement, valid = with_room(measurement, valid)
        first, scale = state.num_labels, state.clutter_scale
        evidence = weigh(state.mixture, measurement, valid, self, clutter_scale=scale)
        chosen = choose(state.mixture, measurement, evidence, self, first_label=first)
        reduced, crowded = reduce_counted(chosen, evidence, self)
        first = first + valid.shape[0]
        reduced = tell_apart(reduced, reduced.weights > self.extraction, first)
        if self.clutter_memory > 0.0:
            share = 1.0 / self.clutter_memory
            seen = jnp.sum(jnp.where(evidence.valid, evidence.clutter, 0.0)) / self.model.clutter.rate
            scale = (1.0 - share) * scale + share * seen
        ok = jnp.isfinite(evidence.log_likelihood)
        info = TrackerInfo(jnp.where(ok, evidence.log_likelihood, 0.0), ok, reduced.mass, crowded)
        return PhdState(reduced, state.step, first + self.capacity, scale), info

    def extract(self, state: PhdState) -> Targets:
        """Components heavier than the threshold, each once."""
        return extract(state.mixture, threshold=self.extraction, copies=False)


class Evidence(eqx.Module):
    """How a scan weighs the predicted components.

    Attributes:
        comparison: all pairs.
        missed: weight of each component if it was not measured.
        pairs: weight of each component given each measurement.
        born: weight of a target that was born with each measurement; zero where the model has none.
        clutter: probability that each measurement comes from no target.
        valid: which measurements there are.
        log_likelihood: of the scan.
    """

    comparison: Comparison
    missed: Float[Array, " k"]
    pairs: Float[Array, "k m"]
    born: Float[Array, " m"]
    clutter: Float[Array, " m"]
    valid: Bool[Array, " m"]
    log_likelihood: Float[Array, ""]


@eqx.filter_jit
def predict(mixture: Mixture, phd: GmPhd, control: Any = None, *, first_label: Any = None) -> Mixture:
    """``D- = gamma + sum_j w_j (p_S N(F m_j, F P_j F^T + Q) + spawned)``.

    Args:
        mixture: the intensity after the last scan.
        phd: the model and options.
        control: of the motion model, such as ``dt``.
        first_label: numbers of new components begin here; None for one above the largest.

    Returns:
        The intensity before the next scan: survivors, spawned ones, births.

    References:
        Vo and Ma 2006, eqs. 24-27 [T-75].
    """
    control = finite_or_zero(control)
    states = jax.vmap(_state)(mixture.means, mixture.roots())
    moved = jax.vmap(lambda state: phd.model.filter.predict(state, control))(states)
    weights = phd.model.survival * mixture.weights
    parts = [Mixture(weights, moved.mean, moved.covariance, mixture.labels)]
    if phd.spawning is not None:
        parts.append(_spawned(mixture, states, phd.spawning, control))
    parts.append(phd.model.birth.mixture(jax.tree.map(lambda leaf: leaf[0], mixture.means)))
    first = jnp.max(mixture.labels) + 1 if first_label is None else first_label
    predicted = parts[0]
    for part in parts[1:]:
        labels = first + jnp.arange(part.capacity, dtype=jnp.int32)
        first = first + part.capacity
        predicted = predicted.concatenate(Mixture(part.weights, part.means, part.covariances, labels))
    return predicted


@eqx.filter_jit
def update(
    mixture: Mixture, measurements: Any, valid: Bool[Array, " m"], phd: GmPhd, *, first_label: Any = None
) -> tuple[Mixture, Evidence]:
    """``D = (1 - p_D) D- + sum_z sum_j w_j(z) N(m_j(z), P_j)``.

    Args:
        mixture: the intensity before the scan.
        measurements: stacked.
        valid: which of them there are; those with numbers that are not finite count as absent.
        phd: the model and options.
        first_label: numbers of components born with measurements begin here; None for one above the largest.

    Returns:
        The heaviest components (as many as `phd` has candidates) of the missed, detected and born ones; the weights of
        all.

    References:
        Vo and Ma 2006, eqs. 28-34 [T-75].
    """
    measurements, valid = with_room(measurements, valid)
    evidence = weigh(mixture, measurements, valid, phd)
    first = jnp.max(mixture.labels) + 1 if first_label is None else first_label
    return choose(mixture, measurements, evidence, phd, first_label=first), evidence


@eqx.filter_jit
def reduce(mixture: Mixture, phd: GmPhd) -> Mixture:
    """Prunes, merges and caps, as the options say [T-83]."""
    return reduce_mixture(mixture, phd.capacity, prune=phd.prune, closeness=phd.closeness).mixture


@eqx.filter_jit
def extract(mixture: Mixture, *, threshold: float = 0.5, copies: bool = True) -> Targets:
    """Targets of an intensity: components above a weight.

    Args:
        mixture: the intensity after a scan.
        threshold: on the weight.
        copies: whether a component of weight w stands for ``round(w)`` targets in the same place, as in Vo and Ma's
            table III. (They share a label.)
    """
    chosen = mixture.weights > threshold
    counts = jnp.where(chosen, jnp.maximum(jnp.round(mixture.weights), 1.0) if copies else 1.0, 0.0)
    ends = jnp.cumsum(counts)
    slots = jnp.arange(mixture.capacity)
    rows = jnp.sum(ends[None, :] <= slots[:, None].astype(ends.dtype), axis=1)
    there = slots.astype(ends.dtype) < ends[-1]
    kept = mixture.take(jnp.where(there, rows, 0))
    return Targets(kept.means, kept.covariances, kept.weights, kept.labels, there)


@eqx.filter_jit
def run(
    mixture: Mixture, phd: GmPhd, controls: Any, measurements: Any, valid: Bool[Array, "t m"], *, copies: bool = True
) -> tuple[Mixture, History]:
    """A pass over a recording; the history holds the `Targets` after each scan."""

    def keep(state):
        return extract(state.mixture, threshold=phd.extraction, copies=copies)

    state, history = run_filter(phd, phd.init(mixture), controls, measurements, valid, keep=keep)
    return state.mixture, history


def weigh(
    mixture: Mixture, measurements: Any, valid: Bool[Array, " m"], phd: GmPhd, *, clutter_scale: Any = 1.0
) -> Evidence:
    """The weights of all explanations of a scan."""
    model = phd.model
    valid = count_valid(measurements, valid)
    measurements = finite_or_zero(measurements)
    comparison = compare(model.filter, mixture.means, mixture.roots(), measurements, valid, phd.gate)
    detection = jax.vmap(model.detection.probability)(mixture.means)
    expected = detection * mixture.weights
    pairs = safe_log(expected)[:, None] + comparison.log_likelihood
    clutter = jax.vmap(model.clutter.log_intensity)(measurements) + safe_log(jnp.asarray(clutter_scale, pairs.dtype))
    born = jnp.full_like(clutter, -jnp.inf)
    rates = jnp.sum(expected) + model.clutter.rate * clutter_scale
    if isinstance(model.birth, MeasuredBirth):
        born = jax.vmap(model.birth.log_intensity)(measurements)
        if phd.gate is not None:  # what a target may explain gives no birth
            born = jnp.where(jnp.any(comparison.inside & mixture.valid[:, None], axis=0), -jnp.inf, born)
        rates = rates + model.birth.rate
    total = _total(pairs, clutter, born)
    explained = valid & jnp.isfinite(total)
    total = jnp.where(explained, total, 0.0)
    pairs, clutter, born = (
        jax.vmap(lambda row: jnp.where(explained, jnp.exp(jnp.where(explained, row - total, 0.0)), 0.0))(part)
        for part in (pairs, clutter[None, :], born[None, :])
    )
    likelihood = jnp.sum(jnp.where(explained, total, 0.0)) - rates
    return Evidence(comparison, mixture.weights - expected, pairs, born[0], clutter[0], explained, likelihood)


def choose(mixture: Mixture, measurements: Any, evidence: Evidence, phd: GmPhd, *, first_label: Any) -> Mixture:
    """The heaviest components after a scan, with their states."""
    measurements = finite_or_zero(measurements)
    num, num_measured = evidence.pairs.shape
    parts = [evidence.missed, evidence.pairs.reshape(-1)]
    birth = phd.model.birth
    if isinstance(birth, MeasuredBirth):
        parts.append(evidence.born)
    weights = jnp.concatenate(parts)
    candidates = 2 * phd.capacity if phd.candidates is None else phd.candidates
    weights, places = lax.top_k(weights, min(candidates, weights.shape[0]))
    pair = jnp.maximum(places - num, 0)
    rows = jnp.where(places < num, places, jnp.minimum(pair // num_measured, num - 1))
    columns = pair % num_measured
    means, roots = jax.vmap(lambda i, j: corrected(mixture.means, evidence.comparison, i, j))(rows, columns)
    old = mixture.take(rows)
    missed = places < num
    means = _select(missed, old.means, means)
    covariances = _select(missed, old.covariances, matmul(roots, roots.mT))
    labels = old.labels
    if isinstance(birth, MeasuredBirth):
        new = places >= num + num * num_measured
        columns = jnp.where(new, places - num - num * num_measured, 0)
        seeds = jax.vmap(lambda j: birth.seed(jax.tree.map(lambda leaf: leaf[j], measurements)))(columns)
        means = _select(new, seeds.mean, means)
        covariances = _select(new, seeds.covariance, covariances)
        labels = jnp.where(new, first_label + columns.astype(jnp.int32), labels)
    return Mixture(weights, means, covariances, labels)


def reduce_counted(chosen: Mixture, evidence: Evidence, phd: GmPhd) -> tuple[Mixture, Int[Array, ""]]:
    """A smaller mixture, and how many components found no room: there, or among those that were chosen."""
    reduced = reduce_mixture(chosen, phd.capacity, prune=phd.prune, closeness=phd.closeness)

    def count(weights):
        return jnp.sum((weights >= phd.prune) & (weights > 0.0))

    left = count(evidence.missed) + count(evidence.pairs) + count(evidence.born) - count(chosen.weights)
    return reduced.mixture, reduced.crowded + left


def tell_apart(mixture: Mixture, target: Bool[Array, " k"], first_label: Any) -> Mixture:
    """Of several targets with one label the heaviest keeps it, and the others are numbered anew."""
    same = mixture.labels[:, None] == mixture.labels[None, :]
    earlier = jnp.triu(jnp.ones(same.shape, bool), 1)
    double = target & jnp.any(same & earlier & target[:, None], axis=0)
    fresh = first_label + jnp.arange(mixture.capacity, dtype=jnp.int32)
    labels = jnp.where(double, fresh, mixture.labels)
    return Mixture(mixture.weights, mixture.means, mixture.covariances, labels)


def safe_log(value: Float[Array, "*s"]) -> Float[Array, "*s"]:
    """Logarithm, minus infinity at zero without a bad derivative."""
    there = value > 0.0
    return jnp.where(there, jnp.log(jnp.where(there, value, 1.0)), -jnp.inf)


def _total(pairs: Float[Array, "k m"], clutter: Float[Array, " m"], born: Float[Array, " m"]) -> Float[Array, " m"]:
    return logsumexp(jnp.concatenate([pairs, clutter[None, :], born[None, :]]), axis=0)


def _state(mean: Any, root: Float[Array, "d d"]) -> GaussianState:
    return GaussianState(mean, root, jnp.zeros((), jnp.int32))


def _spawned(mixture: Mixture, states: GaussianState, spawning: Spawning, control: Any) -> Mixture:
    spread = jax.vmap(lambda state: spread_motion(spawning.motion, state, control))(states)
    covariances = matmul(spread.image, spread.image.mT)
    return Mixture(spawning.weight * mixture.weights, spread.mean, covariances)


def _select(condition: Bool[Array, " n"], new: Any, old: Any) -> Any:
    def pick(a, b):
        return jnp.where(condition.reshape(-1, *[1] * (a.ndim - 1)), a, b)

    return jax.tree.map(pick, new, old)
