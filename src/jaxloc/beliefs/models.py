"""Motion and sensor models: transition and measurement densities with noise in the tangent space."""

import math
from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Key

from jaxloc._linalg import matmul
from jaxloc.beliefs import validity
from jaxloc.beliefs.square_root import cholesky, whiten
from jaxloc.poses import local, retract, tangent_dimension


class Motion(eqx.Module):
    """The transition density ``p(x' | x, u)``: ``x' = retract(move(x, u), w)``, ``w ~ N(0, covariance(x, u))``.

    States are vectors, poses, or any pytree of them; a control holds the inputs of one step, such as its ``dt``.
    Parameters that may be learned are array fields.
    """

    @abstractmethod
    def move(self, state: Any, control: Any) -> Any:
        """The state after one step without noise."""

    @abstractmethod
    def covariance(self, state: Any, control: Any) -> Float[Array, "d d"]:
        """Covariance of the noise in the tangent space of the moved state."""

    def linearize(self, state: Any, control: Any) -> tuple[Any, Float[Array, "d d"]]:
        """The moved state and the Jacobian between the tangent spaces of both; override where it is short."""
        return _linearize(lambda x: self.move(x, control), state)

    def noise_dimension(self, state: Any) -> int:
        """Number of standard normal numbers of `perturb`: the tangent dimension unless overridden."""
        return tangent_dimension(state)

    def perturb(self, state: Any, control: Any, normal: Float[Array, " k"]) -> Any:
        """The next state for standard normal numbers: ``retract(move(x, u), L n)``, ``L L^T = covariance``.

        Particle filters draw the numbers of all particles at once and map this over them. Override it (and
        `noise_dimension`) where noise has a simpler form, or is not normal in the tangent space.
        """
        root = cholesky(self.covariance(state, control))
        return retract(self.move(state, control), matmul(root, normal))

    def sample(self, state: Any, control: Any, *, key: Key[Array, ""]) -> Any:
        """One random next state: `perturb` by new random numbers."""
        normal = jax.random.normal(key, (self.noise_dimension(state),), dtype_of(state))
        return self.perturb(state, control, normal)

    def log_prob(self, state: Any, control: Any, moved: Any) -> Float[Array, ""]:
        """Log density of a next state."""
        deviation = local(self.move(state, control), moved)
        return log_normal(deviation, self.covariance(state, control), jnp.ones(deviation.shape, bool))


class Sensor(eqx.Module):
    """The measurement density ``p(z | x)``: ``z = retract(expect(x, z), v)``, ``v ~ N(0, covariance(x, z))``.

    Measurements are any pytrees; give angles as `jaxloc.poses.SO2`, so that differences wrap. `expect` and
    `covariance` get the measurement for its identity only (which landmark, which beacon, which beams: integer leaves),
    not for its values.

    The covariance is ordered as the tangent of the measurement: as its leaves are. JAX orders the entries of a dict
    **alphabetically by key**, not by insertion: of ``{"range": r, "bearing": b}`` the bearing comes first. Records
    (`equinox.Module`) and tuples keep the order of their fields. `jaxloc.poses.tangent_labels` of a measurement shows
    the order.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> measurement = {"range": jnp.array(5.0), "bearing": jl.poses.SO2.from_angle(0.1)}
        >>> jl.poses.tangent_labels(measurement)
        ('bearing.rotation', 'range')
    """

    @abstractmethod
    def expect(self, state: Any, measurement: Any) -> Any:
        """The measurement predicted without noise, with the structure of the measurement."""

    @abstractmethod
    def covariance(self, state: Any, measurement: Any) -> Float[Array, "m m"]:
        """Covariance of the noise in the tangent space of the measurement."""

    def linearize(self, state: Any, measurement: Any) -> tuple[Any, Float[Array, "m d"]]:
        """The predicted measurement and its Jacobian by the tangent of the state; override where it is short."""
        return _linearize(lambda x: self.expect(x, measurement), state)

    def log_prob(self, state: Any, measurement: Any, valid: Bool[Array, "*m"]) -> Float[Array, ""]:
        """Log density of a measurement; invalid and non-finite entries are ignored; NaN without a covariance.

        Args:
            state: state at which it is evaluated.
            measurement: the measurement.
            valid: one Boolean, or one for each tangent direction of the measurement.
        """
        residual, mask = innovation(self.expect(state, measurement), measurement, valid)
        covariance = self.covariance(state, measurement)
        density = log_normal(residual, covariance, mask)
        return jnp.where(validity.is_covariance(mask_covariance(covariance, mask)), density, jnp.nan)


def innovation(
    expected: Any, measurement: Any, valid: Bool[Array, "*m"]
) -> tuple[Float[Array, " m"], Bool[Array, " m"]]:
    """The innovation of a measurement: measured minus predicted, and the mask of its valid directions.

    Args:
        expected: the predicted measurement.
        measurement: the measurement; non-finite entries are masked.
        valid: one Boolean, or one for each tangent direction.

    Returns:
        ``local(expected, measurement)``, zero where masked, and the mask.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> read = jnp.array([3.0, jnp.nan])
        >>> residual, mask = jl.beliefs.models.innovation(jnp.ones(2), read, jnp.array(True))
        >>> residual.tolist(), mask.tolist()
        ([2.0, 0.0], [True, False])
    """
    finite = jnp.isfinite(local(lax.stop_gradient(expected), lax.stop_gradient(measurement)))
    mask = finite & jnp.broadcast_to(valid, finite.shape)
    # Non-finite values are replaced before they are used: their derivatives would be non-finite as well.
    safe = jax.tree.map(_finite_or, measurement, expected)
    return jnp.where(mask, local(expected, safe), 0.0), mask


def mask_covariance(covariance: Float[Array, "m m"], mask: Bool[Array, " m"]) -> Float[Array, "m m"]:
    """The covariance with unit variance and zero correlation in masked directions.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> jl.beliefs.models.mask_covariance(jnp.full((2, 2), 4.0), jnp.array([True, False])).tolist()
        [[4.0, 0.0], [0.0, 1.0]]
    """
    eye = jnp.eye(mask.shape[0], dtype=covariance.dtype)
    return jnp.where(mask[:, None] & mask[None, :], covariance, eye)


def log_normal(
    residual: Float[Array, " m"], covariance: Float[Array, "m m"], mask: Bool[Array, " m"]
) -> Float[Array, ""]:
    """Log density of a residual under a normal of mean zero; masked directions are ignored.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> zero, eye = jnp.zeros(2), jnp.eye(2)
        >>> round(float(jl.beliefs.models.log_normal(zero, eye, jnp.array([True, False]))), 3)
        -0.919
    """
    root = cholesky(mask_covariance(covariance, mask))
    squared = jnp.sum(whiten(root, jnp.where(mask, residual, 0.0)) ** 2)
    count = jnp.sum(mask).astype(squared.dtype)
    return -0.5 * squared - jnp.sum(jnp.log(jnp.diagonal(root))) - 0.5 * math.log(2.0 * math.pi) * count


def dtype_of(value: Any) -> Any:
    """The dtype of the floating arrays of a pytree.

    Example:
        >>> import jaxloc as jl
        >>> jl.beliefs.models.dtype_of(jl.poses.SE2(0.0, 0.0, 0.0)).name
        'float32'
    """
    return jnp.result_type(*[leaf for leaf in jax.tree.leaves(value) if eqx.is_inexact_array(leaf)])


def _finite_or(value: Any, fallback: Any) -> Any:
    if not eqx.is_inexact_array(value):
        return value
    return jnp.where(jnp.isfinite(value), value, lax.stop_gradient(fallback))


def _linearize(function: Any, state: Any) -> tuple[Any, Array]:
    value = function(state)

    def in_tangent(delta):
        return local(value, function(retract(state, delta)))

    return value, jax.jacfwd(in_tangent)(jnp.zeros(tangent_dimension(state), dtype_of(state)))
