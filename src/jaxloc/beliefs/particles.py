"""Particle sets: weighted samples of any state, and estimates from them."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key

from jaxloc import _tree as tree
from jaxloc._linalg import matmul
from jaxloc.beliefs import validity
from jaxloc.beliefs.gaussian import Gaussian
from jaxloc.beliefs.models import dtype_of
from jaxloc.poses import SE2, SE3, SO2, SO3, local, retract
from jaxloc.poses.lie_group import Group

NOTHING = -1e30  # log weight of zero weight: finite, so that sums and gradients are finite
_SQUARINGS = 5


class Particles(eqx.Module):
    """Weighted samples: ``p(x) = sum_i w_i delta(x - x_i)``, with log weights of any common offset.

    Args:
        values: a pytree of arrays and poses, stacked along a leading axis "n".
        log_weights: "n"; None for equal ones. A NaN or infinite weight counts as zero; where every weight is zero,
            all estimates weight the valid particles equally.
        valid: "n", mask of the slots in use; None for all. The others have no weight.

    References:
        Review section 3.1 [R-5]; Gordon, Salmond, Smith, "Novel approach to nonlinear/non-Gaussian Bayesian state
        estimation", IEE Proc. F 1993.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> cloud = jl.beliefs.Particles(jnp.array([[0.0], [4.0]]), jnp.log(jnp.array([0.75, 0.25])))
        >>> cloud.mean().round(4).tolist(), cloud.best().tolist(), round(float(cloud.ess), 4)
        ([1.0], [0.0], 1.6)
    """

    values: Any
    log_weights: Float[Array, " n"]
    valid: Bool[Array, " n"]

    def __init__(
        self, values: Any, log_weights: Float[Array, " n"] | None = None, valid: Bool[Array, " n"] | None = None
    ):
        self.values = values
        if log_weights is None:
            log_weights = jnp.zeros(jax.tree.leaves(values)[0].shape[0], dtype_of(values))
        self.log_weights = log_weights
        self.valid = jnp.ones(log_weights.shape, bool) if valid is None else valid

    @staticmethod
    def from_gaussian(gaussian: Gaussian, num_particles: int, *, key: Key[Array, ""]) -> "Particles":
        """Equally weighted particles sampled from a normal density; none is valid where it is no density."""
        mean, covariance = validity.usable_or_unknown(gaussian.mean, gaussian.covariance)
        values = Gaussian(mean, covariance).sample(num_particles, key=key)
        good = jnp.full(num_particles, validity.usable(gaussian.mean, gaussian.covariance))
        return Particles(values, valid=good)

    @staticmethod
    def uniform(
        lower: Float[Array, " d"], upper: Float[Array, " d"], num_particles: int, *, key: Key[Array, ""]
    ) -> "Particles":
        """Equally weighted particles, uniform over a box of vectors."""
        fraction = jax.random.uniform(key, (num_particles, lower.shape[0]), lower.dtype)
        return Particles(lower[None, :] + fraction * (upper - lower)[None, :])

    @staticmethod
    def uniform_planar(
        lower: Float[Array, "2"], upper: Float[Array, "2"], num_particles: int, *, key: Key[Array, ""]
    ) -> "Particles":
        """Equally weighted planar poses, uniform over a rectangle (m) and all headings [R-11, R-13]."""
        fraction = jax.random.uniform(key, (num_particles, 3), lower.dtype)
        xy = lower[None, :] + fraction[:, :2] * (upper - lower)[None, :]
        return Particles(jax.vmap(SE2)(xy[:, 0], xy[:, 1], jnp.pi * (2.0 * fraction[:, 2] - 1.0)))

    def usable(self) -> "Particles":
        """The particles without values that are not finite or overflow: their slots are not valid.

        Example:
            >>> import jax.numpy as jnp, jaxloc as jl
            >>> jl.beliefs.Particles(jnp.array([[1.0], [jnp.nan]])).usable().valid.tolist()
            [True, False]
        """
        good = tree.slots_within_range(self.values)
        return Particles(
            jax.vmap(tree.where)(good, self.values, validity.neutral(self.values)), self.log_weights, self.valid & good
        )

    @property
    def size(self) -> int:
        """Number of slots."""
        return self.log_weights.shape[-1]

    @property
    def count(self) -> Int[Array, ""]:
        """Number of slots in use."""
        return jnp.sum(self.valid, dtype=jnp.int32)

    @property
    def ok(self) -> Bool[Array, ""]:
        """Whether any particle has weight."""
        return jnp.max(finite_log_weights(self)) > 0.5 * NOTHING

    @property
    def log_total(self) -> Float[Array, ""]:
        """Logarithm of the sum of the weights; `NOTHING` where it is zero."""
        log_weights = finite_log_weights(self)
        return jnp.where(self.ok, lax.stop_gradient(jnp.max(log_weights)) + _log_sum(log_weights, self.valid), NOTHING)

    @property
    def log_mean_weight(self) -> Float[Array, ""]:
        """Logarithm of the mean weight of the valid particles: in importance sampling, the log evidence."""
        return self.log_total - jnp.log(jnp.maximum(self.count, 1).astype(self.log_weights.dtype))

    @property
    def weights(self) -> Float[Array, " n"]:
        """Normalized weights."""
        return jnp.where(self.valid, jnp.exp(self.normalize().log_weights), 0.0)

    @property
    def ess(self) -> Float[Array, ""]:
        """Effective sample size ``1 / sum w_i^2`` of the normalized weights [R-9].

        References:
            Kong, Liu, Wong, "Sequential imputations and Bayesian missing data problems", JASA 1994.
        """
        return 1.0 / jnp.maximum(jnp.sum(self.weights**2), float(jnp.finfo(self.log_weights.dtype).tiny))

    def normalize(self) -> "Particles":
        """The same density with normalized, finite log weights; equal ones where all were zero."""
        log_weights = finite_log_weights(self)
        shifted = log_weights - lax.stop_gradient(jnp.max(log_weights)) - _log_sum(log_weights, self.valid)
        return Particles(self.values, jnp.where(self.valid, jnp.maximum(shifted, NOTHING), NOTHING), self.valid)

    def take(self, indices: Int[Array, " m"]) -> Any:
        """Values of some particles, stacked; indices must be in range."""
        return jax.tree.map(lambda leaf: leaf.at[indices].get(mode="promise_in_bounds"), self.values)

    def best(self) -> Any:
        """The particle of largest weight [R-8]."""
        index = jnp.argmax(finite_log_weights(self))
        return jax.tree.map(lambda leaf: leaf[index], self.values)

    def mean(self) -> Any:
        """Weighted mean [R-8].

        Arrays and positions are averaged, headings by the mean (cos, sin), rotations in space by the quaternion
        average. Integers are those of the best particle.

        References:
            Markley, Cheng, Crassidis, Oshman, "Averaging quaternions", J. Guidance 2007, eq. 12.
        """
        weights, best = self.weights, self.best()

        def average(node, nearest):
            if isinstance(node, Group):
                return _mean_pose(node, weights, nearest)
            return _mean_array(node, weights) if eqx.is_inexact_array(node) else nearest

        return jax.tree.map(average, self.values, best, is_leaf=lambda node: isinstance(node, Group))

    def local_mean(self, bandwidth: Float[Array, " d"]) -> Any:
        """Weighted mean around the best particle, by a normal kernel in its tangent space [R-8].

        Other modes of the density, several bandwidths away, have no influence.

        Args:
            bandwidth: standard deviation of the kernel for each tangent direction.

        References:
            Dellaert, Fox, Burgard, Thrun, "Monte Carlo localization for mobile robots", ICRA 1999, section 3
            ("robust mean").
        """
        best = self.best()
        deltas = self.deviations(best)
        kernel = jnp.exp(-0.5 * jnp.sum((deltas / bandwidth[None, :]) ** 2, axis=1))
        weights = jnp.where(self.valid, self.weights * kernel, 0.0)
        total = jnp.maximum(jnp.sum(weights), float(jnp.finfo(weights.dtype).tiny))
        return retract(best, jnp.sum(weights[:, None] * deltas, axis=0) / total)

    def deviations(self, center: Any) -> Float[Array, "n d"]:
        """Tangents from a value to each particle; zero for invalid ones."""

        def one(value, valid):
            return local(center, tree.where(valid, value, center))

        return jax.vmap(one)(self.values, self.valid)

    def covariance(self) -> Float[Array, "d d"]:
        """Weighted covariance in the tangent space of the mean."""
        return self.gaussian().covariance

    def gaussian(self) -> Gaussian:
        """The normal density with the mean and covariance of the particles."""
        mean = self.mean()
        deltas = self.deviations(mean)
        return Gaussian(mean, matmul(deltas.T, self.weights[:, None] * deltas))


def finite_log_weights(particles: Particles) -> Float[Array, " n"]:
    """Log weights with `NOTHING` for invalid particles and for zero or non-finite weights.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> cloud = jl.beliefs.Particles(jnp.zeros((2, 1)), jnp.array([0.0, jnp.nan]))
        >>> (jl.beliefs.particles.finite_log_weights(cloud) < -1e29).tolist()
        [False, True]
    """
    log_weights = particles.log_weights
    good = particles.valid & (log_weights > NOTHING) & (log_weights < jnp.inf)
    return jnp.where(good, jnp.where(good, log_weights, 0.0), NOTHING)


def _log_sum(log_weights: Array, valid: Array) -> Array:
    """Logarithm of the sum of weights over the largest; of the number of valid particles where all are zero."""
    parts = jnp.where(valid, jnp.exp(log_weights - lax.stop_gradient(jnp.max(log_weights))), 0.0)
    return jnp.log(jnp.maximum(jnp.sum(parts), float(jnp.finfo(parts.dtype).tiny)))


def _mean_array(values: Array, weights: Array) -> Array:
    # Zero times infinity would be NaN.
    weights = weights.reshape(-1, *(1,) * (values.ndim - 1))
    return jnp.sum(jnp.where(weights > 0, weights * values, 0.0), axis=0)


def _mean_pose(poses: Any, weights: Array, nearest: Any) -> Any:
    if len(poses.batch_shape) != 1:
        raise ValueError(
            f"The mean takes one pose per particle; this leaf holds stacks of shape {poses.batch_shape[1:]}."
        )
    if isinstance(poses, SO2):
        return _direction(_mean_array(poses.cos, weights), _mean_array(poses.sin, weights), nearest)
    if isinstance(poses, SO3):
        return _mean_rotation(poses, weights)
    rotation = _mean_pose(poses.rotation, weights, nearest.rotation)
    translation = _mean_array(poses.translation, weights)
    return SE2.from_parts(rotation, translation) if isinstance(poses, SE2) else SE3(rotation, translation)


def _direction(cos: Array, sin: Array, nearest: SO2) -> SO2:
    """The rotation towards a point; where headings cancel, the best one is returned."""
    squared = cos**2 + sin**2
    good = squared > float(jnp.finfo(cos.dtype).eps) ** 2
    scale = 1.0 / jnp.sqrt(jnp.where(good, squared, 1.0))
    return SO2(jnp.where(good, cos * scale, nearest.cos), jnp.where(good, sin * scale, nearest.sin))


def _mean_rotation(rotations: SO3, weights: Array) -> SO3:
    quaternions = jax.vmap(lambda rotation: rotation.quaternion())(rotations)
    moment = matmul(quaternions.T, weights[:, None] * quaternions)
    for _ in range(_SQUARINGS):  # power iteration on the largest eigenvector
        moment = matmul(moment, moment)
        moment = moment / jnp.trace(moment)
    return SO3.from_quaternion(moment[jnp.argmax(jnp.diagonal(moment))])
