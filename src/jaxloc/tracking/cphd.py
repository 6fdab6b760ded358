"""Cardinalized PHD filter: the intensity of targets together with the distribution of their number.

The update is the derivative of one function. With ``phi`` the expected number of missed targets and ``Lambda_z`` the
ratio of targets to clutter at a measurement, the log-likelihood of a scan is ``l(phi, Lambda)``; the weights of missed
components are multiplied by ``dl / d phi``, and those of detected ones sum to ``dl / d log Lambda_z`` for each
measurement. So the elementary symmetric functions that leave one measurement out, which cost a factor M elsewhere, come
from one reverse pass over those of all measurements. All of it is in logarithms.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy.special import gammaln, logsumexp
from jaxtyping import Array, Bool, Float, Int, Key

from jaxloc import _tree as tree
from jaxloc.beliefs import Mixture
from jaxloc.filters import FilterState
from jaxloc.filters.interface import conclude
from jaxloc.tracking import intensity
from jaxloc.tracking.gating import at_least_one, compare, safe_measurements, usable_measurements
from jaxloc.tracking.gmphd import GmPhd
from jaxloc.tracking.intensity import Evidence, safe_log
from jaxloc.tracking.interface import Targets, Tracker, TrackerInfo
from jaxloc.tracking.models.birth import MeasuredBirth

_NEVER = -1e15  # a logarithm of zero whose multiples stay finite


class CphdState(FilterState):
    """State of the CPHD filter.

    Attributes:
        mixture: the intensity.
        cardinality: probability of each number of targets from 0.
        step: number of predictions so far.
        num_labels: number of labels given so far.
    """

    mixture: Mixture
    cardinality: Float[Array, " n"]
    step: Int[Array, ""]
    num_labels: Int[Array, ""]


class GmCphd(Tracker):
    """The Gaussian mixture cardinalized PHD (CPHD) filter.

    Its estimate of the number of targets has less variance than the PHD filter's (equal to its mean). The price is the
    "spooky effect": when a target is missed, weight moves to targets that were measured, however far away [T-76].

    Args:
        phd: a PHD filter, for its model and options. Births at known places only.
        max_targets: largest number of targets in the distribution.

    Raises:
        ValueError: if targets are born with measurements.

    References:
        Vo, Vo and Cantoni, "Analytic implementations of the cardinalized probability hypothesis density filter", IEEE
        TSP 2007 [T-64].
    """

    phd: GmPhd
    max_targets: int = eqx.field(static=True, default=30)

    def __check_init__(self):
        if isinstance(self.phd.model.birth, MeasuredBirth):
            raise ValueError("GmCphd needs births at known places (StaticBirth): its births precede the measurements.")

    def init(self, prior: Mixture) -> CphdState:
        """The state of a Poisson prior with a given intensity."""
        state = self.phd.init(prior)
        cardinality = _poisson(prior.mass, self.max_targets)
        return CphdState(state.mixture, cardinality, state.step, state.num_labels)

    def predict(self, state: CphdState, control: Any, *, key: Key[Array, ""] | None = None) -> CphdState:
        """Each target survives by itself; births are a Poisson number."""
        del key
        phd, first = self.phd, state.num_labels
        mixture = intensity.predict(state.mixture, phd.model, control, first_label=first, spawning=phd.spawning)
        born = mixture.weights[state.mixture.capacity :]
        _, sums = tree.protect(_predicted_number, state.cardinality, phd.model.survival_probability(), jnp.sum(born))
        return CphdState(mixture, sums, state.step + 1, first + born.shape[0])

    def update(
        self, state: CphdState, measurement: Any, valid: Bool[Array, " m"], *, key: Key[Array, ""] | None = None
    ) -> tuple[CphdState, TrackerInfo]:
        """The intensity and the cardinality given a scan; the predicted ones where the scan cannot be used."""
        del key
        measurement, valid = at_least_one(measurement, valid)
        ok, (after, info) = tree.protect(GmCphd._updated, self, state, measurement, valid)
        held = CphdState(
            intensity.predicted_only(state.mixture, self.phd.capacity), state.cardinality, state.step, after.num_labels
        )
        return conclude(ok, after, info, held)

    def _updated(
        self, state: CphdState, measurement: Any, valid: Bool[Array, " m"]
    ) -> tuple[Bool[Array, ""], tuple[CphdState, TrackerInfo]]:
        evidence, cardinality = self._weigh(state, measurement, valid)
        first = state.num_labels
        reduced, crowded = self.phd.reduced(state.mixture, measurement, evidence, first)
        reduced = intensity.make_labels_unique(reduced, _most_probable(reduced, cardinality), first)
        after = CphdState(reduced, cardinality, state.step, first + self.phd.capacity)
        ok = (
            tree.all_finite((after, evidence.log_likelihood))
            & self.phd.model.usable
            & jnp.any(evidence.comparison.usable)
        )
        count = jnp.sum(cardinality * jnp.arange(cardinality.shape[0], dtype=cardinality.dtype))
        info = TrackerInfo(jnp.where(ok, evidence.log_likelihood, 0.0), ok, count, crowded)
        return ok, (after, info)

    def extract(self, state: CphdState) -> Targets:
        """The heaviest components, as many as the most probable number of targets."""
        kept = state.mixture.take(jnp.argsort(-state.mixture.weights))
        there = _most_probable(kept, state.cardinality)
        return Targets(kept.means, kept.covariances, kept.weights, kept.labels, there)

    def _weigh(
        self, state: CphdState, measurements: Any, valid: Bool[Array, " m"]
    ) -> tuple[Evidence, Float[Array, " n"]]:
        model, mixture = self.phd.model, state.mixture
        valid = usable_measurements(measurements, valid)
        measurements = safe_measurements(measurements, valid)
        comparison = compare(model.filter, mixture.means, mixture.roots(), measurements, valid, self.phd.gate)
        detection, known = model.detect(mixture.means)
        comparison = eqx.tree_at(lambda c: c.usable, comparison, comparison.usable & known)
        expected = detection * mixture.weights
        pairs = safe_log(expected)[:, None] + comparison.log_likelihood
        density = jax.vmap(model.clutter.log_density)(measurements)
        # The derivative of a sum over nothing is NaN.
        some = jnp.any(jnp.isfinite(pairs), axis=0)
        sums = jnp.where(some, logsumexp(jnp.where(some[None, :], pairs, 0.0), axis=0), -jnp.inf)
        seen = jnp.isfinite(sums) & valid
        ratios = jnp.where(seen, sums - density, _NEVER)
        log_rate, count = safe_log(model.clutter.rate), jnp.sum(valid)
        terms = _cardinality_terms(state.cardinality, mixture.mass, jnp.maximum(log_rate, _NEVER), count)
        missed = jnp.sum(mixture.weights - expected)
        log_missed = jnp.maximum(safe_log(missed), _NEVER)
        likelihood, (by_missed, by_ratio) = jax.value_and_grad(_log_likelihood, argnums=(0, 1))(
            log_missed, ratios, terms
        )
        posterior = _posterior(log_missed, ratios, terms)
        by_ratio = jnp.where(seen, by_ratio, 0.0)
        factor = by_missed / jnp.where(missed > 0.0, missed, 1.0)
        shares = jnp.exp(jnp.where(seen[None, :], pairs - jnp.where(seen, sums, 0.0)[None, :], -jnp.inf))
        total = likelihood + jnp.sum(jnp.where(valid, density, 0.0)) - model.clutter.rate
        evidence = Evidence(
            comparison,
            missed=(mixture.weights - expected) * factor,
            pairs=shares * by_ratio[None, :],
            born=jnp.zeros_like(ratios),
            clutter=jnp.where(valid, 1.0 - by_ratio, 0.0),
            valid=valid,
            log_likelihood=total,
        )
        return evidence, posterior


def survive(cardinality: Float[Array, " n"], survival: Float[Array, ""]) -> Float[Array, " n"]:
    """Distribution of the number of survivors when targets survive independently (binomial thinning).

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> jl.tracking.cphd.survive(jnp.array([0.0, 0.0, 1.0]), jnp.array(0.5)).round(3).tolist()
        [0.25, 0.5, 0.25]
    """
    before = jnp.arange(cardinality.shape[0], dtype=cardinality.dtype)[None, :]
    after = before.T
    dying = jnp.maximum(before - after, 0.0)
    choices = gammaln(before + 1.0) - gammaln(after + 1.0) - gammaln(dying + 1.0)
    stays, goes = jnp.maximum(safe_log(survival), _NEVER), jnp.maximum(safe_log(1.0 - survival), _NEVER)
    thinning = jnp.where(after <= before, jnp.exp(choices + after * stays + dying * goes), 0.0)
    return jnp.sum(thinning * cardinality[None, :], axis=1)


def symmetric_functions(logs: Float[Array, " m"], order: int) -> Float[Array, " n"]:
    """Logarithms of the elementary symmetric functions ``e_0 ... e_order`` of numbers given by theirs.

    References:
        Vo, Vo and Cantoni 2007, section III.C (Newton-Girard is left out: all terms here are positive).

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> logs = jl.tracking.cphd.symmetric_functions(jnp.log(jnp.array([1.0, 2.0, 3.0])), 3)
        >>> jnp.exp(logs).round(2).tolist()
        [1.0, 6.0, 11.0, 6.0]
    """
    none = jnp.full((order + 1,), _NEVER, logs.dtype).at[0].set(0.0)

    def multiply(sums, log):
        shifted = jnp.concatenate([jnp.full((1,), _NEVER, logs.dtype), sums[:-1] + log])
        return jnp.logaddexp(sums, jnp.maximum(shifted, _NEVER)), None

    return lax.scan(multiply, none, jnp.maximum(logs, _NEVER))[0]


def _predicted_number(
    cardinality: Float[Array, " n"], survival: Float[Array, ""], born: Float[Array, ""]
) -> tuple[Bool[Array, ""], Float[Array, " n"]]:
    """Distribution of the number of survivors and newborn targets; unchanged where it is not finite."""
    largest = cardinality.shape[0] - 1
    sums = jnp.convolve(survive(cardinality, survival), _poisson(born, largest), precision="highest")[: largest + 1]
    sums = sums / jnp.sum(sums)
    ok = tree.all_finite(sums)
    return ok, jnp.where(ok, sums, cardinality)


def _most_probable(mixture: Mixture, cardinality: Float[Array, " n"]) -> Bool[Array, " k"]:
    """Which components of a sorted mixture are targets."""
    return (jnp.arange(mixture.capacity) < jnp.argmax(cardinality)) & mixture.valid


def _poisson(mean: Float[Array, ""], largest: int) -> Float[Array, " n"]:
    numbers = jnp.arange(largest + 1, dtype=mean.dtype)
    logs = numbers * jnp.maximum(safe_log(mean), _NEVER) - mean - gammaln(numbers + 1.0)
    weights = jnp.exp(logs)
    return weights / jnp.sum(weights)


class _Terms(eqx.Module):
    """Log weights of n targets of which j are measured; the exponents of the expected number of missed ones."""

    logs: Float[Array, "n j"]
    missed: Float[Array, "n j"]


def _cardinality_terms(
    cardinality: Float[Array, " n"], mass: Float[Array, ""], log_rate: Float[Array, ""], count: Int[Array, ""]
) -> _Terms:
    """``log (p(n) n! / (n - j)! lambda^(M - j) / N^n)``."""
    size, dtype = cardinality.shape[0], cardinality.dtype
    total = jnp.arange(size, dtype=dtype)[:, None]
    seen = jnp.arange(size, dtype=dtype)[None, :]
    left, false = jnp.maximum(total - seen, 0.0), count.astype(dtype) - seen
    logs = jnp.maximum(safe_log(cardinality), _NEVER)[:, None] + gammaln(total + 1.0) - gammaln(left + 1.0)
    logs = logs + jnp.maximum(false, 0.0) * log_rate - total * jnp.log(jnp.maximum(mass, jnp.finfo(dtype).tiny))
    return _Terms(jnp.where((seen <= total) & (false >= 0.0), logs, _NEVER), left)


def _joint(log_missed: Float[Array, ""], ratios: Float[Array, " m"], terms: _Terms) -> Float[Array, "n j"]:
    sums = symmetric_functions(ratios, terms.logs.shape[1] - 1)
    return jnp.maximum(terms.logs + terms.missed * log_missed + sums[None, :], _NEVER)


def _log_likelihood(log_missed: Float[Array, ""], ratios: Float[Array, " m"], terms: _Terms) -> Float[Array, ""]:
    return logsumexp(_joint(log_missed, ratios, terms))


def _posterior(log_missed: Float[Array, ""], ratios: Float[Array, " m"], terms: _Terms) -> Float[Array, " n"]:
    rows = logsumexp(_joint(log_missed, ratios, terms), axis=1)
    return jnp.exp(rows - logsumexp(rows))
