"""Gating: likelihoods and innovations of all pairs of predicted targets and measurements."""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxloc import _tree as tree
from jaxloc._linalg import matmul
from jaxloc.beliefs import chi2_quantile, validity
from jaxloc.beliefs.models import innovation
from jaxloc.beliefs.square_root import product, whiten
from jaxloc.filters import GaussianState
from jaxloc.filters.kalman import GaussianFilter, retract_root, without_zero_pivots


class Comparison(eqx.Module):
    """All pairs of targets and measurements.

    Attributes:
        log_likelihood: ``log N(z; h(x), S)``; minus infinity for invalid measurements and outside the gate.
        squared: Mahalanobis distance squared.
        inside: whether a pair passes the gate.
        residuals: whitened innovations ``S^-1/2 (z - h(x))``.
        roots: root of the covariance of (measurement, state) of each target.
        usable: which targets the sensor can measure: with a finite prediction and a covariance of its noise.
    """

    log_likelihood: Float[Array, "k m"]
    squared: Float[Array, "k m"]
    inside: Bool[Array, "k m"]
    residuals: Float[Array, "k m z"]
    roots: Float[Array, "k n n"]
    usable: Bool[Array, " k"]

    def innovation_covariances(self) -> Float[Array, "k z z"]:
        """S of each target."""
        size = self.residuals.shape[-1]
        return matmul(self.roots[:, :size, :size], self.roots[:, :size, :size].mT)

    def rest(self) -> Float[Array, "k d d"]:
        """Posterior covariance roots of the targets, the same for every measurement."""
        size = self.residuals.shape[-1]
        return self.roots[:, size:, size:]


def at_least_one(measurements: Any, valid: Bool[Array, " m"]) -> tuple[Any, Bool[Array, " slots"]]:
    """The measurements padded to at least one slot, so that code on their first entry works for empty sets."""
    if valid.shape[0] > 0:
        return measurements, valid
    return jax.tree.map(lambda leaf: jnp.zeros((1, *leaf.shape[1:]), leaf.dtype), measurements), jnp.zeros(1, bool)


def usable_measurements(measurements: Any, valid: Bool[Array, " m"]) -> Bool[Array, " m"]:
    """Mask of the measurements that are valid, finite and within the range of numbers."""
    return valid & tree.slots_within_range(measurements)


def safe_measurements(measurements: Any, usable: Bool[Array, " m"]) -> Any:
    """The measurements with zeros and identities in place of those that are not usable."""
    return jax.vmap(tree.where)(usable, measurements, validity.neutral(measurements))


def compare(
    filt: GaussianFilter,
    means: Any,
    roots: Float[Array, "k d d"],
    measurements: Any,
    valid: Bool[Array, " m"],
    gate: float | None = None,
) -> Comparison:
    """Compares every target with every measurement; covariances are computed once per target.

    Args:
        filt: the filter of one target, for its measurement model.
        means: of the targets, stacked.
        roots: of their covariances.
        measurements: stacked.
        valid: mask of the measurements.
        gate: probability that a target's own measurement passes; None for no gate.

    References:
        Bar-Shalom, Li, Kirubarajan 2001, section 3.3 [T-58], [T-85].
    """
    valid = usable_measurements(measurements, valid)
    measurements = safe_measurements(measurements, valid)
    template = jax.tree.map(lambda leaf: leaf[0], measurements)

    def expect(mean, root):
        found = filt.innovation(GaussianState(mean, root, jnp.zeros((), jnp.int32)), template, jnp.array(True))
        return found.joint.mean, found.joint.root(), jnp.all(found.mask)

    expected, both, usable = jax.vmap(expect)(means, roots)
    differences = jax.vmap(lambda center: jax.vmap(lambda z, v: innovation(center, z, v)[0])(measurements, valid))(
        expected
    )
    size = differences.shape[-1]
    measured = jax.vmap(without_zero_pivots)(both[:, :size, :size])
    residuals = jax.vmap(lambda root, rows: whiten(root, rows.T).T)(measured, differences)
    squared = jnp.sum(residuals**2, axis=-1)
    volume = jnp.sum(jnp.log(jnp.diagonal(measured, axis1=-2, axis2=-1)), axis=-1) + 0.5 * size * math.log(
        2.0 * math.pi
    )
    usable = usable & jax.vmap(tree.all_finite)(both)
    inside = valid[None, :] & usable[:, None] & (squared < tree.largest(squared.dtype))
    if gate is not None:
        with jax.ensure_compile_time_eval():
            bound = float(chi2_quantile(gate, float(size)))
        inside = inside & (squared <= bound)
    likelihood = jnp.where(inside, -0.5 * squared - volume[:, None], -jnp.inf)
    return Comparison(likelihood, squared, inside, residuals, both, usable)


def corrected(
    means: Any, comparison: Comparison, target: Int[Array, ""], measurement: Int[Array, ""]
) -> tuple[Any, Float[Array, "d d"]]:
    """Posterior mean and covariance root of a target given a measurement.

    Args:
        means: of the targets, as given to `compare`.
        comparison: of all pairs.
        target: row of the pair.
        measurement: column of the pair.
    """
    size = comparison.residuals.shape[-1]
    root = comparison.roots[target]
    delta = product(root[size:, :size], comparison.residuals[target, measurement])
    return retract_root(jax.tree.map(lambda leaf: leaf[target], means), delta, root[size:, size:])
