"""Steps on an intensity, a Gaussian mixture of expected target numbers, that the PHD and CPHD filters share."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy.special import logsumexp
from jaxtyping import Array, Bool, Float, Int

from jaxloc import _tree as tree
from jaxloc._linalg import matmul
from jaxloc.beliefs import Closeness, Mixture, Motion, reduce_mixture, validity
from jaxloc.filters import GaussianState
from jaxloc.filters.kalman import linearized_motion
from jaxloc.poses.lie_group import as_floats
from jaxloc.tracking.gating import Comparison, compare, corrected, safe_measurements, usable_measurements
from jaxloc.tracking.models.birth import Birth, MeasuredBirth
from jaxloc.tracking.models.target import TargetModel


class Spawning(eqx.Module):
    """Targets that split off others.

    Args:
        weight: expected number of targets that one target spawns between two scans.
        motion: from the state of the parent to that of the child.

    References:
        Vo and Ma 2006, eq. 22 [T-75].
    """

    weight: Float[Array, ""]
    motion: Motion

    def __init__(self, weight: Any, motion: Motion):
        (self.weight,), self.motion = as_floats(weight), motion

    def intensity(self, parents: Mixture, states: GaussianState, control: Any) -> Mixture:
        """Intensity of the spawned targets.

        Args:
            parents: the mixture before the prediction.
            states: its components as states, stacked.
            control: of the motion, such as ``dt``.
        """
        moved = jax.vmap(lambda state: linearized_motion(self.motion, state, control))(states)
        return Mixture(self.weight * parents.weights, moved.mean, matmul(moved.output, moved.output.mT))


class Evidence(eqx.Module):
    """Weights of the components after a scan, for each explanation of each measurement.

    Attributes:
        comparison: of all pairs of component and measurement.
        missed: weight of each component without a measurement.
        pairs: weight of each component given each measurement.
        born: weight of a target born with each measurement; zero where the model has none.
        clutter: probability that each measurement is clutter.
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


def predict(
    mixture: Mixture, model: TargetModel, control: Any, *, first_label: Any, spawning: Spawning | None = None
) -> Mixture:
    """``D- = gamma + sum_j w_j (p_S N(F m_j, F P_j F^T + Q) + spawned)``.

    Args:
        mixture: the intensity after the last scan.
        model: motion, survival and births.
        control: of the motion model, such as ``dt``.
        first_label: label of the first new component; the others follow.
        spawning: targets that split off others.

    Returns:
        The intensity before the next scan: survivors, spawned ones, births.

    References:
        Vo and Ma 2006, eqs. 24-27 [T-75].
    """
    predicted = tree.protect(_predicted, mixture, model, validity.finite_or_neutral(control), first_label, spawning)[1]
    return predicted.usable()


def _predicted(
    mixture: Mixture, model: TargetModel, control: Any, first_label: Any, spawning: Spawning | None
) -> tuple[Bool[Array, ""], Mixture]:
    zero = jnp.zeros((), jnp.int32)
    states = jax.vmap(lambda mean, root: GaussianState(mean, root, zero))(mixture.means, mixture.roots())
    moved = jax.vmap(lambda state: model.filter.predict(state, control))(states)
    predicted = Mixture(model.survival_probability() * mixture.weights, moved.mean, moved.covariance, mixture.labels)
    parts = [] if spawning is None else [spawning.intensity(mixture, states, control)]
    parts.append(model.birth.mixture(jax.tree.map(lambda leaf: leaf[0], mixture.means)))
    for part in parts:
        labels = first_label + jnp.arange(part.capacity, dtype=jnp.int32)
        first_label = first_label + part.capacity
        predicted = predicted.concatenate(Mixture(part.weights, part.means, part.covariances, labels))
    return tree.all_finite(predicted), predicted


def predicted_only(mixture: Mixture, capacity: int) -> Mixture:
    """The heaviest components of a predicted mixture: what is left where a scan cannot be used."""
    mixture = mixture.usable()
    _, order = lax.top_k(lax.stop_gradient(mixture.weights), min(capacity, mixture.capacity))
    return mixture.take(order).padded(capacity)


def weigh(
    mixture: Mixture,
    measurements: Any,
    valid: Bool[Array, " m"],
    model: TargetModel,
    *,
    gate: float | None = None,
    clutter_scale: Any = 1.0,
) -> Evidence:
    """Weights of all explanations of a scan, under the Poisson assumption of the PHD filter.

    Args:
        mixture: the intensity before the scan.
        measurements: stacked.
        valid: which of them there are; those with non-finite numbers count as absent.
        model: detection, clutter and births with measurements.
        gate: probability that a target's own measurement passes; None for no gate.
        clutter_scale: clutter rate over that of the model.

    References:
        Vo and Ma 2006, eqs. 28-34 [T-75].
    """
    valid = usable_measurements(measurements, valid)
    measurements = safe_measurements(measurements, valid)
    comparison = compare(model.filter, mixture.means, mixture.roots(), measurements, valid, gate)
    detection, known = model.detect(mixture.means)
    comparison = eqx.tree_at(lambda c: c.usable, comparison, comparison.usable & known)
    expected = detection * mixture.weights
    pairs = safe_log(expected)[:, None] + comparison.log_likelihood
    clutter = jax.vmap(model.clutter.log_intensity)(measurements) + safe_log(jnp.asarray(clutter_scale, pairs.dtype))
    born = jnp.full_like(clutter, -jnp.inf)
    rates = jnp.sum(expected) + model.clutter.rate * clutter_scale
    if isinstance(model.birth, MeasuredBirth):
        born = jax.vmap(model.birth.log_intensity)(measurements)
        if gate is not None:  # a measurement inside the gate of an existing target gives no birth
            born = jnp.where(jnp.any(comparison.inside & mixture.valid[:, None], axis=0), -jnp.inf, born)
        rates = rates + model.birth.rate
    total = logsumexp(jnp.concatenate([pairs, clutter[None, :], born[None, :]]), axis=0)
    explained = valid & jnp.isfinite(total)
    total = jnp.where(explained, total, 0.0)
    pairs, clutter, born = (
        jax.vmap(lambda row: jnp.where(explained, jnp.exp(jnp.where(explained, row - total, 0.0)), 0.0))(part)
        for part in (pairs, clutter[None, :], born[None, :])
    )
    likelihood = jnp.sum(jnp.where(explained, total, 0.0)) - rates
    return Evidence(comparison, mixture.weights - expected, pairs, born[0], clutter[0], explained, likelihood)


def heaviest(
    mixture: Mixture, measurements: Any, evidence: Evidence, birth: Birth, *, candidates: int, first_label: Any
) -> Mixture:
    """The heaviest of the missed, detected and born components after a scan, with their states.

    Args:
        mixture: the intensity before the scan.
        measurements: stacked.
        evidence: weights of all components.
        birth: of the model.
        candidates: how many components are taken.
        first_label: label of a component born with the first measurement; those of the others follow.
    """
    measurements = safe_measurements(measurements, evidence.valid)
    num, num_measured = evidence.pairs.shape
    parts = [evidence.missed, evidence.pairs.reshape(-1)]
    if isinstance(birth, MeasuredBirth):
        parts.append(evidence.born)
    weights = jnp.concatenate(parts)
    weights, places = lax.top_k(weights, min(candidates, weights.shape[0]))
    pair = jnp.maximum(places - num, 0)
    rows = jnp.where(places < num, places, jnp.minimum(pair // num_measured, num - 1))
    columns = pair % num_measured
    means, roots = jax.vmap(lambda i, j: corrected(mixture.means, evidence.comparison, i, j))(rows, columns)
    old = mixture.take(rows)
    missed = places < num
    means = jax.vmap(tree.where)(missed, old.means, means)
    covariances = jax.vmap(tree.where)(missed, old.covariances, matmul(roots, roots.mT))
    labels = old.labels
    if isinstance(birth, MeasuredBirth):
        new = places >= num + num * num_measured
        columns = jnp.where(new, places - num - num * num_measured, 0)
        seeds = jax.vmap(lambda j: birth.seed(jax.tree.map(lambda leaf: leaf[j], measurements)))(columns)
        means = jax.vmap(tree.where)(new, seeds.mean, means)
        covariances = jax.vmap(tree.where)(new, seeds.covariance, covariances)
        labels = jnp.where(new, first_label + columns.astype(jnp.int32), labels)
    return Mixture(weights, means, covariances, labels)


def reduce(
    chosen: Mixture, evidence: Evidence, capacity: int, *, prune: float, closeness: Closeness
) -> tuple[Mixture, Int[Array, ""]]:
    """The mixture pruned, merged and cut to a capacity, and how many components were dropped for lack of room [T-83].

    Args:
        chosen: what `heaviest` took.
        evidence: weights of all components, to count those that were not taken.
        capacity: components that are kept.
        prune: weight below which a component is dropped.
        closeness: which components are merged.
    """
    reduced = reduce_mixture(chosen, capacity, prune=prune, closeness=closeness)

    def count(weights: Array) -> Array:
        return jnp.sum((weights >= prune) & (weights > 0.0))

    left = count(evidence.missed) + count(evidence.pairs) + count(evidence.born) - count(chosen.weights)
    return reduced.mixture, reduced.crowded + left


def make_labels_unique(mixture: Mixture, target: Bool[Array, " k"], first_label: Any) -> Mixture:
    """Of several targets with one label the heaviest keeps it, and the others get new ones.

    Args:
        mixture: sorted by weight.
        target: which components count as targets.
        first_label: new labels begin here.
    """
    same = mixture.labels[:, None] == mixture.labels[None, :]
    earlier = jnp.triu(jnp.ones(same.shape, bool), 1)
    double = target & jnp.any(same & earlier & target[:, None], axis=0)
    fresh = first_label + jnp.arange(mixture.capacity, dtype=jnp.int32)
    labels = jnp.where(double, fresh, mixture.labels)
    return Mixture(mixture.weights, mixture.means, mixture.covariances, labels)


def safe_log(value: Float[Array, "*s"]) -> Float[Array, "*s"]:
    """Logarithm; minus infinity at zero, with a finite derivative."""
    positive = value > 0.0
    return jnp.where(positive, jnp.log(jnp.where(positive, value, 1.0)), -jnp.inf)
