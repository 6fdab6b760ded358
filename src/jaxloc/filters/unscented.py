"""Unscented, cubature and Gauss-Hermite Kalman filters (sigma-point filters)."""

import itertools
import math
from abc import abstractmethod
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxloc.beliefs import Motion, Sensor
from jaxloc.beliefs.models import innovation
from jaxloc.beliefs.square_root import product
from jaxloc.filters.interface import GaussianState
from jaxloc.filters.kalman import GaussianFilter, Innovation, JointCovariance, noise_root, process_root
from jaxloc.poses import is_flat, local, retract

_MEAN_STEPS = 3  # of the intrinsic mean on a manifold; the error is squared each time


class Points(NamedTuple):
    """Sigma points of a standard normal.

    Attributes:
        offsets: "k d".
        weights: of the mean, "k".
        weights_covariance: of the covariance, "k"; only the first may be negative.
    """

    offsets: np.ndarray
    weights: np.ndarray
    weights_covariance: np.ndarray


class Rule(eqx.Module):
    """A sigma-point rule: offsets and weights."""

    @abstractmethod
    def points(self, size: int) -> Points:
        """The points for a tangent space of some dimension."""


class Unscented(Rule):
    """The unscented transform: 2 d + 1 points at ``+-alpha sqrt(d + kappa)`` sigmas.

    The default (alpha 1, beta 0, ``kappa = max(3 - d, 0)``) matches the normal's kurtosis along each axis up to three
    dimensions and has no negative weight. A negative central weight of the covariance is taken out of its root by a
    downdate, which is always defined but amplifies rounding: keep alpha near one in float32.

    Args:
        alpha: scale of the offsets.
        beta: correction of the central weight of the covariance; 2 is best for a normal and small alpha.
        kappa: secondary scale; None for ``max(3 - d, 0)``.

    References:
        Julier and Uhlmann, Proc. IEEE 2004; Wan and van der Merwe, 2001, eq. 15 [T-57].

    Example:
        >>> import jaxloc as jl
        >>> jl.filters.Unscented().points(2).weights.round(3).tolist()
        [0.333, 0.167, 0.167, 0.167, 0.167]
    """

    alpha: float = eqx.field(static=True, default=1.0)
    beta: float = eqx.field(static=True, default=0.0)
    kappa: float | None = eqx.field(static=True, default=None)

    def points(self, size: int) -> Points:
        """2 d + 1 points."""
        scale = self.alpha**2 * (size + (max(3 - size, 0) if self.kappa is None else self.kappa))
        if scale <= 0:
            raise ValueError(f"Unscented needs alpha^2 (d + kappa) > 0; it got {scale} for d = {size}.")
        corners = math.sqrt(scale) * np.eye(size)
        weights = np.r_[1.0 - size / scale, np.full(2 * size, 0.5 / scale)]
        extra = np.r_[1.0 - self.alpha**2 + self.beta, np.zeros(2 * size)]
        return Points(np.concatenate([np.zeros((1, size)), corners, -corners]), weights, weights + extra)


class Cubature(Rule):
    """The third-degree spherical rule: 2 d points of equal weight at ``+-sqrt(d)`` sigmas.

    References:
        Arasaratnam and Haykin, "Cubature Kalman filters", IEEE TAC 2009.

    Example:
        >>> import jaxloc as jl
        >>> jl.filters.Cubature().points(2).weights.tolist()
        [0.25, 0.25, 0.25, 0.25]
    """

    def points(self, size: int) -> Points:
        """2 d points."""
        corners = math.sqrt(size) * np.eye(size)
        weights = np.full(2 * size, 0.5 / size)
        return Points(np.concatenate([corners, -corners]), weights, weights)


class GaussHermite(Rule):
    """The product of one-dimensional Gauss-Hermite rules: ``order^d`` points, exact to degree ``2 order - 1``.

    Args:
        order: points along each direction.

    References:
        Ito and Xiong, "Gaussian filters for nonlinear filtering problems", IEEE TAC 2000.

    Example:
        >>> import jaxloc as jl
        >>> jl.filters.GaussHermite(3).points(1).offsets.round(3).ravel().tolist()
        [-1.732, 0.0, 1.732]
    """

    order: int = eqx.field(static=True, default=3)

    def points(self, size: int) -> Points:
        """``order^d`` points."""
        if self.order < 2:
            raise ValueError(f"GaussHermite needs an order of at least 2; it got {self.order}.")
        roots, shares = np.polynomial.hermite_e.hermegauss(self.order)
        offsets = np.array(list(itertools.product(roots, repeat=size)))
        weights = np.array([math.prod(chosen) for chosen in itertools.product(shares / shares.sum(), repeat=size)])
        return Points(offsets, weights, weights)


class SigmaPointFilter(GaussianFilter):
    """Unscented, cubature or Gauss-Hermite Kalman filter in square-root form, on vectors, poses, or any pytree of them.

    Points are ``retract(mean, S u_i)``; the mean of their images is intrinsic on manifolds. New points are
    taken from the prediction before each update. Noise is added in the tangent space of the image.

    Args:
        motion: how the state moves.
        sensor: what is measured.
        rule: `Unscented`, `Cubature` or `GaussHermite`.
        gate: probability that a measurement from the model passes; None for no gate.

    References:
        Van der Merwe and Wan, "The square-root unscented Kalman filter", ICASSP 2001; Hauberg, Lauze and Pedersen,
        "Unscented Kalman filtering on Riemannian manifolds", JMIV 2013 [T-57].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> eye = jnp.eye(1)
        >>> filt = jl.filters.SigmaPointFilter(jl.filters.LinearMotion(eye, eye), jl.filters.LinearSensor(eye, eye))
        >>> state = filt.predict(filt.init(jl.beliefs.Gaussian(jnp.zeros(1), eye)), None)
        >>> state, info = filt.update(state, jnp.array([3.0]), jnp.array(True))
        >>> [round(float(number), 3) for number in state.mean]
        [2.0]
    """

    motion: Motion
    sensor: Sensor
    rule: Rule = eqx.field(default_factory=Unscented)
    gate: float | None = eqx.field(static=True, default=None)

    def predict_joint(self, state: GaussianState, control: Any) -> JointCovariance:
        """By the motion evaluated at the points."""
        noise = process_root(self.motion.covariance(state.mean, control))
        return self._joint(lambda x: self.motion.move(x, control), state, noise, None)

    def innovation(self, state: GaussianState, measurement: Any, valid: Bool[Array, "*m"]) -> Innovation:
        """By the sensor evaluated at the points."""
        expected = self.sensor.expect(state.mean, measurement)
        _, mask = innovation(expected, measurement, valid)
        noise, mask = noise_root(self.sensor.covariance(state.mean, measurement), mask)
        joint = self._joint(lambda x: self.sensor.expect(x, measurement), state, noise, mask)
        residual, mask = innovation(joint.mean, measurement, mask)
        return Innovation(joint, jnp.where(mask, residual, 0.0), mask)

    def _joint(
        self,
        function: Callable[[Any], Any],
        state: GaussianState,
        noise: Float[Array, "m m"],
        mask: Bool[Array, " m"] | None,
    ) -> JointCovariance:
        root = state.covariance_sqrt
        points = self.rule.points(root.shape[0])
        deltas = product(jnp.asarray(points.offsets, root.dtype), root.T)
        images = jax.vmap(lambda delta: function(retract(state.mean, delta)))(deltas)
        mean, deviations = intrinsic_mean(images, jnp.asarray(points.weights, root.dtype))
        if mask is not None:
            deviations = jnp.where(mask[None, :], deviations, 0.0)
        scale = jnp.asarray(np.sqrt(np.abs(points.weights_covariance)), root.dtype)[:, None]
        after, before = (scale * deviations).T, (scale * deltas).T
        removed = None
        if points.weights_covariance[0] < 0.0:
            removed = jnp.concatenate([after[:, 0], before[:, 0]])
            after, before = after[:, 1:], before[:, 1:]
        filler = jnp.zeros((before.shape[0], noise.shape[0]), root.dtype)
        after, before = jnp.concatenate([after, noise], axis=1), jnp.concatenate([before, filler], axis=1)
        return JointCovariance(mean, after, before, removed)


def intrinsic_mean(values: Any, weights: Float[Array, " k"]) -> tuple[Any, Float[Array, "k d"]]:
    """Weighted mean of stacked values, and the tangents from it to each.

    Args:
        values: stacked along a leading axis; poses may be among them.
        weights: that add up to one; they may be negative.

    Returns:
        The point from which the weighted tangents vanish (after three steps from the value of the largest weight, the
        first among equals), and the tangents.

    Example:
        >>> import jax, jax.numpy as jnp, jaxloc as jl
        >>> headings = jax.vmap(jl.poses.SO2.from_angle)(jnp.array([3.1, -3.1]))
        >>> mean, _ = jl.filters.unscented.intrinsic_mean(headings, jnp.array([0.5, 0.5]))
        >>> bool(jnp.abs(jnp.abs(mean.angle()) - jnp.pi) < 1e-5)
        True
    """
    center = jax.tree.map(lambda leaf: leaf[jnp.argmax(weights)], lax.stop_gradient(values))
    for _ in range(1 if is_flat(center) else _MEAN_STEPS):
        center = retract(center, jnp.sum(weights[:, None] * _deviations(center, values), axis=0))
    return center, _deviations(center, values)


def _deviations(center: Any, values: Any) -> Float[Array, "k d"]:
    return jax.vmap(lambda value: local(center, value))(values)
