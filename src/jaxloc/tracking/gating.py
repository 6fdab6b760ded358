"""Predicted targets beside measurements: how likely each pair is, and what each measurement would make of a target."""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxloc._linalg import matmul
from jaxloc.beliefs import chi2_quantile
from jaxloc.beliefs.models import innovation
from jaxloc.beliefs.square_root import product, whiten
from jaxloc.filters import GaussianState
from jaxloc.filters.kalman import GaussianFilter, finite_or_zero, recenter, regular


class Comparison(eqx.Module):
    """Every target beside every measurement.

    Attributes:
        log_likelihood: ``log N(z; h(x), S)``; minus infinity where there is no measurement or none inside the gate.
        squared: Mahalanobis distance squared.
        inside: whether a pair passes the gate.
        residuals: ``S^-1/2 (z - h(x))``: innovations in sigmas.
        roots: root of the covariance of (measurement, state) of each target.
    """

    log_likelihood: Float[Array, "k m"]
    squared: Float[Array, "k m"]
    inside: Bool[Array, "k m"]
    residuals: Float[Array, "k m z"]
    roots: Float[Array, "k n n"]

    def innovation_covariances(self) -> Float[Array, "k z z"]:
        """S of each target."""
        size = self.residuals.shape[-1]
        return matmul(self.roots[:, :size, :size], self.roots[:, :size, :size].mT)

    def rest(self) -> Float[Array, "k d d"]:
        """Roots of the covariances after a measurement, whichever it is: none is stored for a pair."""
        size = self.residuals.shape[-1]
        return self.roots[:, size:, size:]


def with_room(measurements: Any, valid: Bool[Array, " m"]) -> tuple[Any, Bool[Array, " slots"]]:
    """The measurements with at least one slot, so that there is an example of them where there are none."""
    if valid.shape[0] > 0:
        return measurements, valid
    return jax.tree.map(lambda leaf: jnp.zeros((1, *leaf.shape[1:]), leaf.dtype), measurements), jnp.zeros(1, bool)


def count_valid(measurements: Any, valid: Bool[Array, " m"]) -> Bool[Array, " m"]:
    """Which measurements there are: those that are valid, and finite in all their numbers."""
    leaves = [leaf for leaf in jax.tree.leaves(measurements) if eqx.is_inexact_array(leaf)]
    for leaf in leaves:
        valid = valid & jnp.all(jnp.isfinite(leaf), axis=tuple(range(1, leaf.ndim)))
    return valid


def compare(
    filt: GaussianFilter,
    means: Any,
    roots: Float[Array, "k d d"],
    measurements: Any,
    valid: Bool[Array, " m"],
    gate: float | None = None,
) -> Comparison:
    """Every target beside every measurement; what does not depend on the measurement is worked out once a target.

    Args:
        filt: how a target is measured.
        means: of the targets, stacked.
        roots: of their covariances.
        measurements: stacked.
        valid: which of them there are.
        gate: probability that a target's own measurement passes; None for no gate.

    References:
        Bar-Shalom, Li, Kirubarajan 2001, section 3.3 [T-58], [T-85].
    """
    valid = count_valid(measurements, valid)
    measurements = finite_or_zero(measurements)
    template = jax.tree.map(lambda leaf: leaf[0], measurements)

    def expect(mean, root):
        reading = filt.read(GaussianState(mean, root, jnp.zeros((), jnp.int32)), template, jnp.array(True))
        return reading.spread.mean, reading.spread.root()

    expected, both = jax.vmap(expect)(means, roots)
    differences = jax.vmap(lambda center: jax.vmap(lambda z, v: innovation(center, z, v)[0])(measurements, valid))(
        expected
    )
    size = differences.shape[-1]
    spreads = jax.vmap(regular)(both[:, :size, :size])
    residuals = jax.vmap(lambda root, rows: whiten(root, rows.T).T)(spreads, differences)
    squared = jnp.sum(residuals**2, axis=-1)
    volume = jnp.sum(jnp.log(jnp.diagonal(spreads, axis1=-2, axis2=-1)), axis=-1) + 0.5 * size * math.log(2.0 * math.pi)
    inside = jnp.broadcast_to(valid[None, :], squared.shape)
    if gate is not None:
        with jax.ensure_compile_time_eval():
            bound = float(chi2_quantile(gate, float(size)))
        inside = inside & (squared <= bound)
    likelihood = jnp.where(inside, -0.5 * squared - volume[:, None], -jnp.inf)
    return Comparison(likelihood, squared, inside, residuals, both)


def corrected(
    means: Any, comparison: Comparison, target: Int[Array, ""], measurement: Int[Array, ""]
) -> tuple[Any, Float[Array, "d d"]]:
    """The state of a target given a measurement: its mean, and the root of its covariance.

    Args:
        means: of the targets, as they were compared.
        comparison: of all pairs.
        target: row of the pair.
        measurement: column of the pair.
    """
    size = comparison.residuals.shape[-1]
    root = comparison.roots[target]
    delta = product(root[size:, :size], comparison.residuals[target, measurement])
    return recenter(jax.tree.map(lambda leaf: leaf[target], means), delta, root[size:, size:])
