"""Extended Kalman filter on manifolds: iterated, gated, with robust kernels."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxloc.beliefs import Motion, Sensor
from jaxloc.beliefs.models import innovation
from jaxloc.beliefs.square_root import product, whiten
from jaxloc.filters.interface import GaussianInfo, GaussianState
from jaxloc.filters.kalman import (
    GaussianFilter,
    Innovation,
    JointCovariance,
    apply_correction,
    innovation_info,
    linearized_innovation,
    linearized_motion,
    measurement_joint,
    noise_root,
    without_zero_pivots,
)
from jaxloc.poses import carry, is_flat, retract
from jaxloc.solvers.robust_kernels import Loss, Quadratic

_SMALLEST_WEIGHT = 1e-8  # of a robust kernel: the noise of a rejected measurement grows by ten thousand


class ExtendedKalmanFilter(GaussianFilter):
    """The extended Kalman filter (EKF); states are vectors, poses, or any pytree of them.

    An update is Gauss-Newton on ``|local(x-, x)|^2_P + |z - h(x)|^2_R``. One iteration is the usual EKF; more
    of them linearize again at the last result (iterated EKF). The covariance of a pose is transported to the tangent
    space of its new mean. The info (innovation, NIS, likelihood) is of the linearization at the predicted state.

    Args:
        motion: how the state moves.
        sensor: what is measured.
        iterations: Gauss-Newton steps of an update, at least 1.
        gate: probability that a measurement from the model passes the chi-square gate; one that does not leaves the
            state unchanged and does not enter the likelihood. None for no gate.
        loss: robust kernel of the whole measurement, in sigmas: the noise covariance is divided by its weight, which
            is taken at the innovation in the first iteration and at the residual after that.

    Raises:
        ValueError: if iterations or gate are out of range.

    References:
        Bell and Cathey, "The iterated Kalman filter update as a Gauss-Newton method", IEEE TAC 1993; Bourmaud et al.,
        "Continuous-discrete extended Kalman filter on matrix Lie groups", 2015 [T-57], [K-79].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> motion = jl.filters.TwistMotion(0.01 * jnp.eye(3))
        >>> class Position(jl.beliefs.Sensor):
        ...     def expect(self, state, measurement):
        ...         return state.translation
        ...     def covariance(self, state, measurement):
        ...         return 0.01 * jnp.eye(2)
        >>> filt = jl.filters.ExtendedKalmanFilter(motion, Position(), iterations=3)
        >>> state = filt.init(jl.beliefs.Gaussian(jl.poses.SE2.identity(), 0.1 * jnp.eye(3)))
        >>> step = jl.filters.BodyTwist(jnp.array([1.0, 0.0, 0.0]), jnp.array(1.0))
        >>> state, info = filt.update(filt.predict(state, step), jnp.array([1.0, 0.5]), jnp.array(True))
        >>> bool(jnp.allclose(state.mean.translation, jnp.array([1.0, 0.5]), atol=0.05)), bool(state.mean.theta > 0)
        (True, True)
    """

    motion: Motion
    sensor: Sensor
    iterations: int = eqx.field(static=True, default=1)
    gate: float | None = eqx.field(static=True, default=None)
    loss: Loss = eqx.field(default_factory=Quadratic)

    def __check_init__(self):
        if self.iterations < 1:
            raise ValueError(f"An update needs at least 1 iteration; got {self.iterations}.")
        if self.gate is not None and not 0.0 < self.gate < 1.0:
            raise ValueError(f"The gate is a probability between 0 and 1; got {self.gate}.")

    def predict_joint(self, state: GaussianState, control: Any) -> JointCovariance:
        """By the derivative of the motion at the mean."""
        return linearized_motion(self.motion, state, control)

    def innovation(self, state: GaussianState, measurement: Any, valid: Bool[Array, "*m"]) -> Innovation:
        """By the derivative of the sensor at the mean."""
        return linearized_innovation(self.sensor, state, measurement, valid)

    def correct_by(
        self, state: GaussianState, measurement: Any, valid: Bool[Array, "*m"]
    ) -> tuple[GaussianState, GaussianInfo]:
        """The state updated by a measurement: Gauss-Newton steps of `update`."""
        found = self.innovation(state, measurement, valid)
        root = found.joint.root()
        info = innovation_info(root, found, self.gate)
        if not isinstance(self.loss, Quadratic):
            root = _reweighted(found.joint, self.loss.weight(info.nis)).root()
        delta, rest = _step(root, info.innovation)
        for _ in range(self.iterations - 1):
            safe = jnp.where(info.ok & info.accepted & jnp.all(jnp.isfinite(delta)), delta, 0.0)
            delta, rest = self._relinearized(state, measurement, found.mask, safe)
        return apply_correction(state, delta, rest, info), info

    def _relinearized(
        self, state: GaussianState, measurement: Any, mask: Bool[Array, " m"], delta: Float[Array, " d"]
    ) -> tuple[Float[Array, " d"], Float[Array, "d d"]]:
        """A Gauss-Newton step linearized ``delta`` away from the prior mean, in the tangent space of that mean."""
        value = retract(state.mean, delta)
        expected, jacobian = self.sensor.linearize(value, measurement)
        residual, mask = innovation(expected, measurement, mask)
        noise, mask = noise_root(self.sensor.covariance(value, measurement), mask)
        jacobian = jnp.where(mask[:, None], jacobian, 0.0)
        if not is_flat(state.mean):
            jacobian = product(jacobian, carry(state.mean, delta, value))
        residual = jnp.where(mask, residual, 0.0)
        joint = measurement_joint(expected, noise, product(jacobian, state.covariance_sqrt), state)
        if not isinstance(self.loss, Quadratic):
            joint = _reweighted(joint, self.loss.weight(jnp.sum(whiten(noise, residual) ** 2)))
        return _step(joint.root(), residual + product(jacobian, delta))


def _step(root: Float[Array, "n n"], residual: Float[Array, " m"]) -> tuple[Float[Array, " d"], Float[Array, "d d"]]:
    """Posterior tangent and covariance root given an innovation."""
    size = residual.shape[0]
    return product(root[size:, :size], whiten(without_zero_pivots(root[:size, :size]), residual)), root[size:, size:]


def _reweighted(joint: JointCovariance, weight: Float[Array, ""]) -> JointCovariance:
    """The joint covariance with the measurement noise divided by a weight."""
    size = joint.output.shape[0]
    scale = 1.0 / jnp.sqrt(jnp.maximum(weight, _SMALLEST_WEIGHT))
    output = jnp.concatenate([joint.output[:, :size] * scale, joint.output[:, size:]], axis=1)
    return JointCovariance(joint.mean, output, joint.input)
