"""Kalman filter in square-root form, and the parts that the whole family shares.

Every filter of the family gives the joint covariance of a model's output with the state, as scaled deviations side by
side (`JointCovariance`); one orthogonal factorization of these gives the prediction, and one more the update. No
covariance is ever formed, so none can lose its positive definiteness, in float32 and with priors of a standard
deviation 1e5 times that of the measurements.
"""

import math
from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Key

from jaxloc import _tree as tree
from jaxloc.beliefs import Gaussian, Motion, Sensor, chi2_quantile, validity
from jaxloc.beliefs.models import innovation, mask_covariance
from jaxloc.beliefs.square_root import cholesky, downdate, product, triangularize, whiten
from jaxloc.filters.interface import Filter, GaussianInfo, GaussianState, conclude
from jaxloc.poses import carry, is_flat, retract


class LinearSensor(Sensor):
    """``z = H x + v``, ``v ~ N(0, R)``.

    Args:
        matrix: H.
        noise_covariance: R.

    References:
        Kalman, "A new approach to linear filtering and prediction problems", 1960 [T-56].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> sensor = jl.filters.LinearSensor(jnp.array([[1.0, 0.0]]), jnp.eye(1))
        >>> sensor.expect(jnp.array([3.0, 4.0]), None).tolist()
        [3.0]
    """

    matrix: Float[Array, "m d"]
    noise_covariance: Float[Array, "m m"]

    def expect(self, state: Float[Array, " d"], measurement: Any) -> Float[Array, " m"]:
        """``H x``."""
        del measurement
        return product(self.matrix, state)

    def covariance(self, state: Float[Array, " d"], measurement: Any) -> Float[Array, "m m"]:
        """R."""
        del state, measurement
        return self.noise_covariance

    def linearize(self, state: Float[Array, " d"], measurement: Any) -> tuple[Float[Array, " m"], Float[Array, "m d"]]:
        """``H x`` and H."""
        return self.expect(state, measurement), self.matrix


class JointCovariance(eqx.Module):
    """Joint covariance of the state and the output of a model, as a matrix of scaled deviations.

    The covariance of (output, input) is ``A A^T`` with ``A = [output; input]``, less ``c c^T`` where there is one
    (sigma points whose central weight is negative).

    Attributes:
        mean: of the output.
        output: scaled deviations of the output, side by side, the root of the noise included.
        input: those of the state, in the same columns.
        removed: c, of the output and the input, or None.
    """

    mean: Any
    output: Float[Array, "m k"]
    input: Float[Array, "d k"]
    removed: Float[Array, " n"] | None = None

    def root(self) -> Float[Array, "n n"]:
        """Lower triangular root of the covariance of (output, input), n = m + d."""
        both = triangularize(jnp.concatenate([self.output, self.input]))
        return both if self.removed is None else downdate(both, self.removed)

    def output_root(self) -> Float[Array, "m m"]:
        """Lower triangular root of the covariance of the output alone."""
        size = self.output.shape[0]
        root = triangularize(self.output)
        return root if self.removed is None else downdate(root, self.removed[:size])


class Innovation(eqx.Module):
    """Difference of a measurement and its prediction, with their joint covariance.

    Attributes:
        joint: of the predicted measurement and the state.
        residual: measured minus predicted, zero where masked.
        mask: which directions are valid.
    """

    joint: JointCovariance
    residual: Float[Array, " m"]
    mask: Bool[Array, " m"]


class GaussianFilter(Filter):
    """Interface of the Kalman family: two joint covariances, from which predictions and updates follow.

    Attributes:
        gate: probability that a measurement from the model passes the chi-square gate; one that does not leaves the
            state unchanged and does not enter the likelihood. None for no gate.
    """

    gate: eqx.AbstractVar[float | None]

    @abstractmethod
    def predict_joint(self, state: GaussianState, control: Any) -> JointCovariance:
        """Joint covariance of the next state and the state, process noise included."""

    @abstractmethod
    def innovation(self, state: GaussianState, measurement: Any, valid: Bool[Array, "*m"]) -> Innovation:
        """The innovation of a measurement, with the joint covariance of its prediction and the state."""

    def init(self, prior: Gaussian) -> GaussianState:
        """The state of a prior density.

        Where the prior is no density (non-finite numbers, an indefinite covariance), the state is that of
        `beliefs.validity.unknown`, whose updates are not ``ok``.
        """
        mean, covariance = validity.usable_or_unknown(prior.mean, prior.covariance)
        return GaussianState(mean, cholesky(covariance), jnp.zeros((), jnp.int32))

    def predict(self, state: GaussianState, control: Any, *, key: Key[Array, ""] | None = None) -> GaussianState:
        """The state one step ahead; non-finite entries of the control count as zero, or as no motion.

        A prediction beyond the range of numbers leaves the state unchanged, but for its step.
        """
        del key
        ok, moved = tree.protect(_moved, self, state, validity.finite_or_neutral(control))
        return tree.where(ok, moved, GaussianState(state.mean, state.covariance_sqrt, state.step + 1))

    def update(
        self, state: GaussianState, measurement: Any, valid: Bool[Array, "*m"], *, key: Key[Array, ""] | None = None
    ) -> tuple[GaussianState, GaussianInfo]:
        """The state updated by a measurement."""
        del key
        ok, (after, info) = tree.protect(_updated, self, state, measurement, valid)
        return conclude(ok, after, info, state)

    def correct_by(
        self, state: GaussianState, measurement: Any, valid: Bool[Array, "*m"]
    ) -> tuple[GaussianState, GaussianInfo]:
        """`update` without protection from non-finite numbers, which `update` adds; for filters that override it."""
        found = self.innovation(state, measurement, valid)
        root = found.joint.root()
        info = innovation_info(root, found, self.gate)
        return correct(state, root, info), info


def _moved(filt: GaussianFilter, state: GaussianState, control: Any) -> tuple[Bool[Array, ""], GaussianState]:
    joint = filt.predict_joint(state, control)
    moved = GaussianState(joint.mean, joint.output_root(), state.step + 1)
    return tree.within_range(moved), moved


def _updated(
    filt: GaussianFilter, state: GaussianState, measurement: Any, valid: Bool[Array, "*m"]
) -> tuple[Bool[Array, ""], tuple[GaussianState, GaussianInfo]]:
    after, info = filt.correct_by(state, measurement, valid)
    return info.ok & tree.within_range(state), (after, info)


class KalmanFilter(GaussianFilter):
    """The exact filter of linear models with normal noise, in square-root form.

    ``x- = F x + B u``, ``S- = tria[F S, Q^1/2]``; with ``tria[[R^1/2, H S-], [0, S-]] = [[V, 0], [G, S]]`` the update
    is ``x = x- + G V^-1 (z - H x-)``.

    Args:
        motion: how the state moves; `LinearMotion`, `ConstantVelocity`, or any `Motion` that is linear.
        sensor: what is measured; a `LinearSensor`, or any `Sensor` that is linear.
        gate: probability that a measurement from the model passes; None for no gate.

    References:
        Kalman 1960; Kaminski, Bryson and Schmidt, "Discrete square root filtering", IEEE TAC 1971 [T-56], [R-4].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> eye = jnp.eye(1)
        >>> filt = jl.filters.KalmanFilter(jl.filters.LinearMotion(eye, eye), jl.filters.LinearSensor(eye, eye))
        >>> state = filt.predict(filt.init(jl.beliefs.Gaussian(jnp.zeros(1), eye)), None)
        >>> state, info = filt.update(state, jnp.array([3.0]), jnp.array(True))
        >>> state.mean.round(3).tolist(), round(float(info.nis), 3)
        ([2.0], 3.0)
    """

    motion: Motion
    sensor: Sensor
    gate: float | None = eqx.field(static=True, default=None)

    def predict_joint(self, state: GaussianState, control: Any) -> JointCovariance:
        """By the transition matrix."""
        return linearized_motion(self.motion, state, control)

    def innovation(self, state: GaussianState, measurement: Any, valid: Bool[Array, "*m"]) -> Innovation:
        """By the measurement matrix."""
        return linearized_innovation(self.sensor, state, measurement, valid)


def linearized_motion(motion: Motion, state: GaussianState, control: Any) -> JointCovariance:
    """Joint covariance of the next state and the state, by the derivative of the motion."""
    mean, jacobian = motion.linearize(state.mean, control)
    noise = process_root(motion.covariance(state.mean, control))
    carried = product(jacobian, state.covariance_sqrt)
    before = jnp.concatenate([state.covariance_sqrt, jnp.zeros_like(noise)], axis=1)
    return JointCovariance(mean, jnp.concatenate([carried, noise], axis=1), before)


def process_root(covariance: Float[Array, "d d"]) -> Float[Array, "d d"]:
    """Root of the covariance of a motion's noise; NaN where that is not finite, so that the prediction is not used."""
    return jnp.where(tree.all_finite(covariance), cholesky(covariance), jnp.nan)


def linearized_innovation(
    sensor: Sensor, state: GaussianState, measurement: Any, valid: Bool[Array, "*m"]
) -> Innovation:
    """Innovation at the mean, with the joint covariance by the derivative of the sensor."""
    expected, jacobian = sensor.linearize(state.mean, measurement)
    residual, mask = innovation(expected, measurement, valid)
    mask = mask & jnp.all(jnp.isfinite(jacobian), axis=1)
    noise, mask = noise_root(sensor.covariance(state.mean, measurement), mask)
    deviations = product(jnp.where(mask[:, None], jacobian, 0.0), state.covariance_sqrt)
    joint = measurement_joint(expected, noise, deviations, state)
    return Innovation(joint, jnp.where(mask, residual, 0.0), mask)


def measurement_joint(
    expected: Any, noise: Float[Array, "m m"], deviations: Float[Array, "m d"], state: GaussianState
) -> JointCovariance:
    """Joint covariance of a predicted measurement and the state, given its deviations ``H S``."""
    root = state.covariance_sqrt
    before = jnp.concatenate([jnp.zeros((root.shape[0], noise.shape[0]), root.dtype), root], axis=1)
    return JointCovariance(expected, jnp.concatenate([noise, deviations], axis=1), before)


def noise_root(
    covariance: Float[Array, "m m"], mask: Bool[Array, " m"]
) -> tuple[Float[Array, "m m"], Bool[Array, " m"]]:
    """Root of a measurement covariance, unit where masked.

    Directions without a finite variance are masked; all are where the covariance of the others is indefinite.
    """
    known = jnp.sqrt(jnp.abs(lax.stop_gradient(jnp.diagonal(covariance)))) < tree.largest(covariance.dtype)
    finite = mask_covariance(jnp.where(jnp.isfinite(covariance), covariance, 0.0), known)
    # Without the mask, which differs from one batch entry to the next: checked once where all have one covariance.
    sound = validity.factors(cholesky(lax.stop_gradient(finite)), finite)
    mask = mask & known & sound
    return cholesky(mask_covariance(finite, mask)), mask


def innovation_info(root: Float[Array, "n n"], found: Innovation, gate: float | None = None) -> GaussianInfo:
    """Log likelihood, NIS and gate of an innovation.

    Args:
        root: of the covariance of (measurement, state).
        found: the innovation.
        gate: probability that a measurement from the model passes; None for no gate.
    """
    size, mask = found.mask.shape[0], found.mask
    measured = without_zero_pivots(root[:size, :size])
    trial = lax.stop_gradient(jnp.sum(whiten(measured, found.residual) ** 2))
    ok = jnp.isfinite(trial) & jnp.all(jnp.isfinite(lax.stop_gradient(root)))
    # Overflow is removed before it is used: its derivatives would be non-finite as well.
    residual = jnp.where(ok, found.residual, 0.0)
    nis = jnp.sum(whiten(measured, residual) ** 2)
    dof = jnp.sum(mask)
    accepted = jnp.array(True) if gate is None else nis <= _gate_bounds(gate, size, nis.dtype)[dof]
    used = ok & accepted & (dof > 0)
    volume = jnp.sum(jnp.log(jnp.diagonal(measured)))
    likelihood = -0.5 * nis - volume - 0.5 * math.log(2.0 * math.pi) * dof.astype(nis.dtype)
    covariance = product(measured, measured.T)
    return GaussianInfo(jnp.where(used, likelihood, 0.0), ok, residual, covariance, nis, dof, accepted)


def correct(state: GaussianState, root: Float[Array, "n n"], info: GaussianInfo) -> GaussianState:
    """The state updated by an innovation, where it is usable; else unchanged."""
    size = info.innovation.shape[0]
    gain, rest = root[size:, :size], root[size:, size:]
    delta = product(gain, whiten(without_zero_pivots(root[:size, :size]), info.innovation))
    return apply_correction(state, delta, rest, info)


def apply_correction(
    state: GaussianState, delta: Float[Array, " d"], rest: Float[Array, "d d"], info: GaussianInfo
) -> GaussianState:
    """Moves a state along a tangent and replaces its root, where the innovation is usable."""
    mean, rest = retract_root(state.mean, delta, rest)
    moved = GaussianState(mean, rest, state.step)
    return tree.where(info.ok & info.accepted & (info.dof > 0) & tree.all_finite(moved), moved, state)


def retract_root(mean: Any, delta: Float[Array, " d"], root: Float[Array, "d d"]) -> tuple[Any, Float[Array, "d d"]]:
    """A mean moved along a tangent, and a covariance root transported from the old tangent space to the new one.

    To first order: the root is carried by the derivative between the two tangent spaces (for a pose its right
    Jacobian). Vectors have one tangent space only.
    """
    moved = retract(mean, delta)
    return moved, root if is_flat(mean) else triangularize(product(carry(mean, delta, moved), root))


def without_zero_pivots(root: Float[Array, "m m"]) -> Float[Array, "m m"]:
    """A root with every zero pivot (no noise and no uncertainty) replaced by one, so that it can be inverted."""
    zero = jnp.diagonal(root) <= 0.0
    return root + jnp.diag(zero.astype(root.dtype))


def _gate_bounds(probability: float, size: int, dtype: Any) -> Float[Array, " n"]:
    """Bounds of the NIS for each number of valid directions, computed at trace time."""
    with jax.ensure_compile_time_eval():
        bounds = np.asarray(chi2_quantile(probability, np.arange(1.0, size + 1.0)))
    return jnp.asarray(np.concatenate([[0.0], bounds]), dtype)
