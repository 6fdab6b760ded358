"""The Kalman filter in square-root form, and the parts that the whole family shares.

Every member says how a normal density spreads through its models, as scaled deviations side by side (`Spread`); one
orthogonal factorization of these gives the prediction, and one more the update. No covariance is ever formed, so none
can lose its positive definiteness, in float32 and with priors a hundred thousand sigmas wide.
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
from jaxloc.beliefs import Gaussian, Motion, Sensor, chi2_quantile
from jaxloc.beliefs.models import innovation, mask_covariance
from jaxloc.beliefs.square_root import cholesky, downdate, product, triangularize, whiten
from jaxloc.filters.interface import Filter, GaussianInfo, GaussianState
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


class Spread(eqx.Module):
    """How a normal density and its image under a function vary together.

    The covariance of (image, source) is ``A A^T`` with ``A = [image; source]``, less ``c c^T`` where there is one
    (sigma points whose central weight is negative).

    Attributes:
        mean: of the image.
        image: scaled deviations of the image, side by side; the noise's root is among them.
        source: those of the source in the same columns.
        removed: c, of the image and the source, or None.
    """

    mean: Any
    image: Float[Array, "m k"]
    source: Float[Array, "d k"]
    removed: Float[Array, " n"] | None = None

    def root(self) -> Float[Array, "n n"]:
        """Lower triangular root of the covariance of (image, source), n = m + d."""
        both = triangularize(jnp.concatenate([self.image, self.source]))
        return both if self.removed is None else downdate(both, self.removed)

    def image_root(self) -> Float[Array, "m m"]:
        """Lower triangular root of the covariance of the image alone."""
        size = self.image.shape[0]
        root = triangularize(self.image)
        return root if self.removed is None else downdate(root, self.removed[:size])


class Reading(eqx.Module):
    """A measurement beside what was expected.

    Attributes:
        spread: of the expected measurement with the state.
        residual: measured minus expected, zero where masked.
        mask: which directions count.
    """

    spread: Spread
    residual: Float[Array, " m"]
    mask: Bool[Array, " m"]


class GaussianFilter(Filter):
    """What every member of the Kalman family is: two spreads; predictions and updates follow from them.

    Attributes:
        gate: probability that a right measurement passes the chi-square gate; one that does not leaves the state as it
            was, and counts nothing in the likelihood. None for no gate.
    """

    gate: eqx.AbstractVar[float | None]

    @abstractmethod
    def move(self, state: GaussianState, control: Any) -> Spread:
        """How the state after a step varies with the state before it, noise included."""

    @abstractmethod
    def read(self, state: GaussianState, measurement: Any, valid: Bool[Array, "*m"]) -> Reading:
        """The measurement beside the expected one, and how that varies with the state."""

    def init(self, prior: Gaussian) -> GaussianState:
        """The state of a prior density."""
        return GaussianState(prior.mean, cholesky(prior.covariance), jnp.zeros((), jnp.int32))

    def predict(self, state: GaussianState, control: Any, *, key: Key[Array, ""] | None = None) -> GaussianState:
        """The state one step later; entries of the control that are not finite count as zero."""
        del key
        spread = self.move(state, finite_or_zero(control))
        moved = GaussianState(spread.mean, spread.image_root(), state.step + 1)
        return select(_is_finite(moved), moved, GaussianState(state.mean, state.covariance_sqrt, state.step + 1))

    def update(
        self, state: GaussianState, measurement: Any, valid: Bool[Array, "*m"], *, key: Key[Array, ""] | None = None
    ) -> tuple[GaussianState, GaussianInfo]:
        """The state given a measurement."""
        del key
        reading = self.read(state, measurement, valid)
        root = reading.spread.root()
        info = judge(root, reading, self.gate)
        return correct(state, root, info), info


class KalmanFilter(GaussianFilter):
    """The exact filter of linear models with normal noise, in square-root form.

    ``x- = F x + B u``, ``S- = tria[F S, Q^1/2]``; with ``tria[[R^1/2, H S-], [0, S-]] = [[V, 0], [G, S]]`` the update
    is ``x = x- + G V^-1 (z - H x-)``.

    Args:
        motion: how the state moves; `LinearMotion`, `ConstantVelocity`, or any `Motion` that is linear.
        sensor: what is measured; a `LinearSensor`, or any `Sensor` that is linear.
        gate: probability that a right measurement passes; None for no gate.

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

    def move(self, state: GaussianState, control: Any) -> Spread:
        """By the transition matrix."""
        return spread_motion(self.motion, state, control)

    def read(self, state: GaussianState, measurement: Any, valid: Bool[Array, "*m"]) -> Reading:
        """By the measurement matrix."""
        return read_linearized(self.sensor, state, measurement, valid)


def spread_motion(motion: Motion, state: GaussianState, control: Any) -> Spread:
    """The spread of a motion, by its derivative."""
    mean, jacobian = motion.linearize(state.mean, control)
    noise = cholesky(motion.covariance(state.mean, control))
    carried = product(jacobian, state.covariance_sqrt)
    source = jnp.concatenate([state.covariance_sqrt, jnp.zeros_like(noise)], axis=1)
    return Spread(mean, jnp.concatenate([carried, noise], axis=1), source)


def read_linearized(sensor: Sensor, state: GaussianState, measurement: Any, valid: Bool[Array, "*m"]) -> Reading:
    """A measurement beside what the mean predicts, with the spread by the derivative."""
    expected, jacobian = sensor.linearize(state.mean, measurement)
    residual, mask = innovation(expected, measurement, valid)
    mask = mask & jnp.all(jnp.isfinite(jacobian), axis=1)
    noise, mask = noise_root(sensor.covariance(state.mean, measurement), mask)
    seen = product(jnp.where(mask[:, None], jacobian, 0.0), state.covariance_sqrt)
    return Reading(spread_reading(expected, noise, seen, state), jnp.where(mask, residual, 0.0), mask)


def spread_reading(
    expected: Any, noise: Float[Array, "m m"], seen: Float[Array, "m d"], state: GaussianState
) -> Spread:
    """The spread of a measurement whose deviations ``H S`` are given."""
    root = state.covariance_sqrt
    source = jnp.concatenate([jnp.zeros((root.shape[0], noise.shape[0]), root.dtype), root], axis=1)
    return Spread(expected, jnp.concatenate([noise, seen], axis=1), source)


def noise_root(
    covariance: Float[Array, "m m"], mask: Bool[Array, " m"]
) -> tuple[Float[Array, "m m"], Bool[Array, " m"]]:
    """Root of a measurement noise with masked directions cut loose; directions without a finite variance are masked."""
    mask = mask & jnp.isfinite(jnp.diagonal(covariance))
    return cholesky(mask_covariance(covariance, mask)), mask


def judge(root: Float[Array, "n n"], reading: Reading, gate: float | None = None) -> GaussianInfo:
    """What an innovation says: its likelihood, whether it is plausible, whether it can be used.

    Args:
        root: of the covariance of (measurement, state).
        reading: the measurement beside the expected one.
        gate: probability that a right measurement passes; None lets all pass.
    """
    size, mask = reading.mask.shape[0], reading.mask
    spread = regular(root[:size, :size])
    trial = lax.stop_gradient(jnp.sum(whiten(spread, reading.residual) ** 2))
    ok = jnp.isfinite(trial) & jnp.all(jnp.isfinite(lax.stop_gradient(root)))
    # Numbers that overflow are taken out before they are used: their derivatives would be bad as well.
    residual = jnp.where(ok, reading.residual, 0.0)
    nis = jnp.sum(whiten(spread, residual) ** 2)
    dof = jnp.sum(mask)
    accepted = jnp.array(True) if gate is None else nis <= _gates(gate, size, nis.dtype)[dof]
    used = ok & accepted & (dof > 0)
    volume = jnp.sum(jnp.log(jnp.diagonal(spread)))
    likelihood = -0.5 * nis - volume - 0.5 * math.log(2.0 * math.pi) * dof.astype(nis.dtype)
    covariance = product(spread, spread.T)
    return GaussianInfo(jnp.where(used, likelihood, 0.0), ok, residual, covariance, nis, dof, accepted)


def correct(state: GaussianState, root: Float[Array, "n n"], info: GaussianInfo) -> GaussianState:
    """The state given the innovation, where there is one that can be used; else the state as it was."""
    size = info.innovation.shape[0]
    gain, rest = root[size:, :size], root[size:, size:]
    delta = product(gain, whiten(regular(root[:size, :size]), info.innovation))
    return settle(state, delta, rest, info)


def settle(
    state: GaussianState, delta: Float[Array, " d"], rest: Float[Array, "d d"], info: GaussianInfo
) -> GaussianState:
    """Moves a state along a tangent, with its new root, where the info says that there is reason to."""
    mean, rest = recenter(state.mean, delta, rest)
    moved = GaussianState(mean, rest, state.step)
    return select(info.ok & info.accepted & (info.dof > 0) & _is_finite(moved), moved, state)


def recenter(mean: Any, delta: Float[Array, " d"], root: Float[Array, "d d"]) -> tuple[Any, Float[Array, "d d"]]:
    """A mean moved along a tangent, and the root there of a covariance that was given in the tangent space of the mean.

    To first order: the root is carried by the derivative between the two tangent spaces (for a pose its right
    Jacobian). Vectors have one tangent space only.
    """
    moved = retract(mean, delta)
    return moved, root if is_flat(mean) else triangularize(product(carry(mean, delta, moved), root))


def select(condition: Bool[Array, ""], new: Any, old: Any) -> Any:
    """One of two pytrees, leaf by leaf."""
    return tree.where(condition, new, old)


def finite_or_zero(value: Any) -> Any:
    """A pytree with zeros in place of numbers that are not finite."""
    return jax.tree.map(lambda a: jnp.where(jnp.isfinite(a), a, 0.0) if eqx.is_inexact_array(a) else a, value)


def _is_finite(state: GaussianState) -> Bool[Array, ""]:
    leaves = [lax.stop_gradient(leaf) for leaf in jax.tree.leaves(state) if eqx.is_inexact_array(leaf)]
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in leaves]))


def regular(root: Float[Array, "m m"]) -> Float[Array, "m m"]:
    """A root whose pivots can be divided by: an exact zero (no noise, nothing uncertain) becomes one."""
    zero = jnp.diagonal(root) <= 0.0
    return root + jnp.diag(zero.astype(root.dtype))


def _gates(probability: float, size: int, dtype: Any) -> Float[Array, " n"]:
    """Bounds of the NIS for each number of directions, worked out when the program is traced."""
    with jax.ensure_compile_time_eval():
        bounds = np.asarray(chi2_quantile(probability, np.arange(1.0, size + 1.0)))
    return jnp.asarray(np.concatenate([[0.0], bounds]), dtype)
