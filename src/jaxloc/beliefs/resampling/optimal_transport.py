"""Resampling by entropy-regularized optimal transport: deterministic and differentiable."""

import math
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxloc._linalg import matmul
from jaxloc.beliefs.particles import Particles
from jaxloc.poses import retract


def optimal_transport(
    values: Any, log_weights: Float[Array, " n"], *, epsilon: float = 0.1, iterations: int = 30
) -> Any:
    """Equally weighted particles, each a convex combination of the weighted ones by the entropic transport plan.

    ``x_i' = retract(m, n sum_j P_ij local(m, x_j))`` about the mean m, where P transports the weights to equal ones
    at the least squared distance, less ``epsilon`` (times the mean squared distance between particles) times its
    entropy. Sinkhorn's iterations run in logarithms, with a decreasing epsilon. Time and memory grow with n squared.

    The particles are biased: combinations shrink the covariance (the mean is kept) and bias estimates of the
    likelihood, the more the larger epsilon is; the gradient is the exact one of that biased filter.

    Args:
        values: particles, a pytree stacked along the leading axis.
        log_weights: as for `systematic`.
        epsilon: regularization, as part of the mean squared distance between particles.
        iterations: steps of Sinkhorn's algorithm.

    Returns:
        Values of equal weight, stacked.

    References:
        Corenflos, Thornton, Deligiannidis, Doucet, "Differentiable particle filtering via entropy-regularized optimal
        transport", ICML 2021, algorithms 2 and 3; Peyre and Cuturi, *Computational Optimal Transport*, 2019, section 4.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> values, weights = jnp.array([[0.0], [1.0], [2.0]]), jnp.array([0.2, 0.2, 0.6])
        >>> moved = jl.beliefs.resampling.optimal_transport(values, jnp.log(weights), epsilon=0.01)
        >>> bool(jnp.all(jnp.diff(moved[:, 0]) > 0)), round(float(jnp.mean(moved)), 3)
        (True, 1.4)
    """
    cloud = Particles(values, log_weights).normalize()
    center = cloud.mean()
    deltas = cloud.deviations(center)
    moved = matmul(_transport_plan(deltas, cloud.log_weights, epsilon, iterations), deltas)
    # A plan that has not converged moves the mean: that part is subtracted.
    moved = moved + (jnp.sum(cloud.weights[:, None] * deltas, axis=0) - jnp.mean(moved, axis=0))[None, :]
    return jax.vmap(lambda delta: retract(center, delta))(moved)


def _transport_plan(points: Array, log_weights: Array, epsilon: float, iterations: int) -> Array:
    """Rows that sum to one: n times the entropic plan from the weights to equal ones."""
    squares = jnp.sum(points**2, axis=1)
    cost = jnp.maximum(squares[:, None] + squares[None, :] - 2.0 * matmul(points, points.T), 0.0)
    extent = lax.stop_gradient(jnp.mean(cost))
    cost = cost / jnp.where(extent > 0, extent, 1.0)
    level = -math.log(points.shape[0])

    @jax.checkpoint
    def iterate(potential, scale):
        rows = -scale * jax.nn.logsumexp((potential[None, :] - cost) / scale + log_weights[None, :], axis=1)
        return -scale * jax.nn.logsumexp((rows[:, None] - cost) / scale + level, axis=0), None

    # Each step halves epsilon down to its value, which converges faster than a fixed one.
    scales = jnp.maximum(2.0 ** (-jnp.arange(iterations, dtype=points.dtype)), epsilon)
    potential, _ = lax.scan(iterate, jnp.zeros(points.shape[0], points.dtype), scales)
    return jax.nn.softmax((potential[None, :] - cost) / epsilon + log_weights[None, :], axis=1)
