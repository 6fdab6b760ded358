"""Likelihood ratios of track-to-measurement pairs against clutter and new targets, for one scan."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.special import logsumexp
from jaxtyping import Array, Bool, Float, Int

from jaxloc.beliefs import Gaussian, chi2_quantile, validity
from jaxloc.filters import GaussianFilter, GaussianState, InteractingMultipleModel
from jaxloc.tracking.gating import Comparison, compare, corrected, safe_measurements, usable_measurements
from jaxloc.tracking.models.birth import StaticBirth
from jaxloc.tracking.models.target import TargetModel
from jaxloc.tracking.tracks import Tracks

_RAREST = -200.0  # log intensity of false measurements where it would be zero


class NewTargets(eqx.Module):
    """The new targets that measurements may be the first of.

    Attributes:
        states: of the new targets, stacked.
        log_intensity: of first measurements, detection included.
        expected: expected number of first measurements in a scan.
    """

    states: Any
    log_intensity: Float[Array, " m"]
    expected: Float[Array, ""]


class Scan(eqx.Module):
    """A padded set of measurements compared with predicted tracks.

    The log of the sum over all joint associations is

    ``base + log sum_a prod_i (exp log_odds[i, a_i] or, where i has none, exp log_missed[i])``.

    Attributes:
        measurements: finite everywhere.
        valid: mask of the measurements.
        comparison: of Gaussian tracks with them; None for tracks of `InteractingMultipleModel`.
        detection: p_D of each track.
        log_missed: ``log (1 - r p_D)``.
        log_odds: ``log (r p_D N(z; ...) / (kappa + b))``; minus infinity outside the gate.
        newborn: new targets of the measurements.
        share: probability that an unassociated measurement is of a new target, ``b / (kappa + b)``.
        base: log likelihood of the scan if no track were detected.
        usable: whether the sensor can measure any track.
    """

    measurements: Any
    valid: Bool[Array, " m"]
    comparison: Comparison | None
    detection: Float[Array, " k"]
    log_missed: Float[Array, " k"]
    log_odds: Float[Array, "k m"]
    newborn: NewTargets
    share: Float[Array, " m"]
    base: Float[Array, ""]
    usable: Bool[Array, ""]


def compare_scan(
    model: TargetModel, tracks: Tracks, measurements: Any, valid: Bool[Array, " m"], gate: float | None
) -> Scan:
    """Compares every predicted track with every measurement.

    Args:
        model: the target model.
        tracks: as predicted.
        measurements: stacked.
        valid: mask of the measurements.
        gate: probability that a track's own measurement passes; None for no gate.
    """
    present = usable_measurements(measurements, valid)
    measurements = safe_measurements(measurements, present)
    likelihood, comparison, usable = _likelihoods(model.filter, tracks.states, measurements, present, gate)
    detection, known = _detection(model, tracks.means(), tracks.existence)
    newborn = initiate(model, tracks, measurements, present)
    clutter = jax.vmap(model.clutter.log_intensity)(measurements)
    false = jnp.maximum(jnp.logaddexp(clutter, newborn.log_intensity), _RAREST)
    seen = tracks.existence * detection
    inside = jnp.isfinite(likelihood) & (seen > 0.0)[:, None]
    log_seen = jnp.log(jnp.where(seen > 0.0, seen, 1.0))
    odds = log_seen[:, None] + jnp.where(inside, likelihood, 0.0) - false[None, :]
    # Bounded by rounding, for tracks and detections of probability one.
    missed = jnp.log(jnp.maximum(1.0 - seen, float(jnp.finfo(seen.dtype).eps)))
    share = jnp.where(present, jnp.exp(jnp.minimum(newborn.log_intensity - false, 0.0)), 0.0)
    base = jnp.sum(jnp.where(present, false, 0.0)) - model.clutter.rate - newborn.expected
    odds, usable = jnp.where(inside, odds, -jnp.inf), jnp.any(usable & known)
    return Scan(measurements, present, comparison, detection, missed, odds, newborn, share, base, usable)


def initiate(model: TargetModel, tracks: Tracks, measurements: Any, present: Bool[Array, " m"]) -> NewTargets:
    """The new targets of measurements.

    Where births are a mixture, the most likely component of each measurement is updated by it.
    """
    num = present.shape[0]
    first = jax.tree.map(lambda leaf: leaf[0], measurements)
    if isinstance(model.birth, StaticBirth):
        return _from_mixture(model, measurements, present)
    if model.birth.log_intensity(first) is None:
        states = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf[0], (num, *leaf.shape[1:])), tracks.states)
        nothing = jnp.zeros((), tracks.existence.dtype)
        return NewTargets(states, jnp.full((num,), -jnp.inf, nothing.dtype), nothing)
    intensity = jax.vmap(model.birth.log_intensity)(measurements)
    seeds: Any = jax.vmap(model.birth.seed)(measurements)  # not None, since there is an intensity
    good = present & jax.vmap(validity.usable)(seeds.mean, seeds.covariance)
    states = jax.vmap(model.filter.init)(seeds)
    return NewTargets(states, jnp.where(good, intensity, -jnp.inf), model.birth.rate)


def _from_mixture(model: TargetModel, measurements: Any, present: Bool[Array, " m"]) -> NewTargets:
    mixture = model.birth.intensity
    states = jax.vmap(lambda mean, covariance: model.filter.init(Gaussian(mean, covariance)))(
        mixture.means, mixture.covariances
    )
    likelihood, comparison, _ = _likelihoods(model.filter, states, measurements, present, None)
    expected = mixture.weights * _detection(model, mixture.means, mixture.weights)[0]
    possible = jnp.isfinite(likelihood) & (expected > 0.0)[:, None]
    scale = jnp.log(jnp.where(expected > 0.0, expected, 1.0))
    terms = jnp.where(possible, scale[:, None] + jnp.where(possible, likelihood, 0.0), -1e30)
    intensity = jnp.where(jnp.any(possible, axis=0), logsumexp(terms, axis=0), -jnp.inf)
    best = jnp.argmax(terms, axis=0)
    scan = _correct(model.filter, states, comparison, measurements, present, best, jnp.arange(present.shape[0]))
    return NewTargets(scan, intensity, jnp.sum(expected))


def correct_tracks(
    model: TargetModel, tracks: Tracks, scan: Scan, rows: Int[Array, " n"], columns: Int[Array, " n"]
) -> Any:
    """Posterior states of some tracks given a measurement each.

    Args:
        model: the target model.
        tracks: as given to `compare_scan`.
        scan: result of `compare_scan`.
        rows: indices of the tracks.
        columns: indices of the measurements.
    """
    return _correct(model.filter, tracks.states, scan.comparison, scan.measurements, scan.valid, rows, columns)


def _detection(
    model: TargetModel, means: Any, like: Float[Array, " k"]
) -> tuple[Float[Array, " k"], Bool[Array, " k"]]:
    detection, known = model.detect(means)
    return detection.astype(like.dtype), known


def _likelihoods(
    filt: Any, states: Any, measurements: Any, present: Bool[Array, " m"], gate: float | None
) -> tuple[Float[Array, "k m"], Comparison | None, Bool[Array, " k"]]:
    if isinstance(filt, GaussianFilter):
        comparison = compare(filt, states.mean, states.covariance_sqrt, measurements, present, gate)
        return comparison.log_likelihood, comparison, comparison.usable
    if not isinstance(filt, InteractingMultipleModel):
        raise TypeError(
            f"Trackers need a filter of the Kalman family or InteractingMultipleModel; got {type(filt).__name__}."
        )

    def pair(state, z, here):
        _, info = filt.update(state, z, here)
        return (
            info.log_likelihood,
            jnp.min(info.modes.nis),
            info.modes.innovation,
            info.ok & jnp.all(info.modes.dof > 0),
        )

    each = jax.vmap(lambda state: jax.vmap(lambda z, here: pair(state, z, here))(measurements, present))
    likelihood, nis, innovations, usable = each(states)
    inside = present[None, :] & usable
    if gate is not None:
        with jax.ensure_compile_time_eval():
            bound = float(chi2_quantile(gate, float(innovations.shape[-1])))
        inside = inside & (nis <= bound)
    return jnp.where(inside, likelihood, -jnp.inf), None, jnp.any(usable | ~present[None, :], axis=1)


def _correct(
    filt: Any,
    states: Any,
    comparison: Comparison | None,
    measurements: Any,
    present: Bool[Array, " m"],
    rows: Int[Array, " n"],
    columns: Int[Array, " n"],
) -> Any:
    if comparison is not None:

        def given(i, j):
            return GaussianState(*corrected(states.mean, comparison, i, j), states.step[i])

        return jax.vmap(given)(rows, columns)

    def one(i, j):
        state, z = jax.tree.map(lambda leaf: leaf[i], states), jax.tree.map(lambda leaf: leaf[j], measurements)
        return filt.update(state, z, present[j])[0]

    return jax.vmap(one)(rows, columns)
