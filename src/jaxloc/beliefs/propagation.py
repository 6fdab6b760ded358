"""Propagation of a Gaussian through a function: linearized, unscented, or sampled."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from jaxloc._jit import filter_jit
from jaxloc._linalg import matmul
from jaxloc.beliefs.gaussian import Gaussian
from jaxloc.beliefs.square_root import cholesky
from jaxloc.poses import is_flat, local, retract

_MEAN_STEPS = 3  # of the intrinsic mean on a manifold; the error is squared each time


@filter_jit
def propagate_linear(f: Callable[[Any], Any], gaussian: Gaussian) -> Gaussian:
    """Density of ``f(x)`` to first order: ``f(m)`` and ``J P J^T``.

    Args:
        f: function of a value like the mean; gives any pytree of arrays and poses. Pass the same function object (or an
            `equinox.Module` with its data as leaves) again to avoid a new compilation.
        gaussian: density of x.

    Returns:
        Density of f(x) in the tangent space of ``f(m)``.

    References:
        Bar-Shalom, Li, Kirubarajan, *Estimation with Applications*, 2001, section 1.4 [T-72].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> belief = jl.beliefs.Gaussian(jnp.array([2.0]), jnp.array([[0.01]]))
        >>> round(float(jl.beliefs.propagate_linear(jnp.square, belief).covariance[0, 0]), 3)
        0.16
    """
    value = f(gaussian.mean)

    def in_tangent(delta):
        return local(value, f(retract(gaussian.mean, delta)))

    jacobian = jax.jacfwd(in_tangent)(jnp.zeros(gaussian.dimension, gaussian.covariance.dtype))
    return Gaussian(value, matmul(matmul(jacobian, gaussian.covariance), jacobian.T))


@filter_jit
def propagate_unscented(
    f: Callable[[Any], Any], gaussian: Gaussian, *, alpha: float = 1.0, beta: float = 0.0, kappa: float | None = None
) -> Gaussian:
    """Density of ``f(x)`` by the unscented transform: 2 d + 1 sigma points, exact mean for quadratic functions.

    ``x_0 = m``, ``x_i = retract(m, +-sqrt(d + l) L_i)`` with ``l = alpha^2 (d + kappa) - d``; weights ``l / (d + l)``
    (plus ``1 - alpha^2 + beta`` in the covariance) and ``1 / (2 (d + l))``. Means on manifolds are intrinsic.

    The default ``kappa = max(3 - d, 0)`` with ``beta = 0`` matches the normal's kurtosis along each axis up to three
    dimensions and keeps every weight non-negative: the covariance stays positive, also in float32. The often quoted
    ``alpha = 1e-3, beta = 2`` has weights of a million and needs float64.

    Args:
        f: function of a value like the mean; gives any pytree of arrays and poses.
        gaussian: density of x.
        alpha: scale of the sigma points' offsets.
        beta: correction of the central weight for the covariance.
        kappa: secondary scale; None for ``max(3 - d, 0)``.

    Returns:
        Density of f(x) in the tangent space of its mean.

    Raises:
        ValueError: if ``alpha^2 (d + kappa)`` is not positive.

    References:
        Julier and Uhlmann, "Unscented filtering and nonlinear estimation", Proc. IEEE 2004; Wan and van der Merwe, "The
        unscented Kalman filter", 2001, eq. 15 [T-73].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> belief = jl.beliefs.Gaussian(jnp.array([2.0]), jnp.array([[0.01]]))
        >>> round(float(jl.beliefs.propagate_unscented(jnp.square, belief).mean[0]), 3)
        4.01
    """
    size = gaussian.dimension
    scale = alpha**2 * (size + (max(3 - size, 0) if kappa is None else kappa))
    if scale <= 0:
        raise ValueError(f"propagate_unscented needs alpha^2 (d + kappa) > 0; it got {scale} for d = {size}.")
    dtype = gaussian.covariance.dtype
    offsets = scale**0.5 * cholesky(gaussian.covariance).T
    deltas = jnp.concatenate([jnp.zeros((1, size), dtype), offsets, -offsets])
    weights = np.r_[1.0 - size / scale, np.full(2 * size, 0.5 / scale)]
    weights_covariance = weights + np.r_[1.0 - alpha**2 + beta, np.zeros(2 * size)]
    samples = _evaluate(f, gaussian, deltas)
    first = jax.tree.map(lambda leaf: leaf[0], samples)
    return _moments(samples, first, jnp.asarray(weights, dtype), jnp.asarray(weights_covariance, dtype))


@filter_jit
def propagate_sampled(
    f: Callable[[Any], Any], gaussian: Gaussian, *, key: Key[Array, ""], num_samples: int = 256
) -> Gaussian:
    """Density of ``f(x)`` from the moments of random samples.

    Args:
        f: function of a value like the mean; gives any pytree of arrays and poses.
        gaussian: density of x.
        key: random key.
        num_samples: number of samples, at least 2.

    Returns:
        Density of f(x) in the tangent space of its sample mean.

    Raises:
        ValueError: if there are fewer than 2 samples.

    References:
        Thesis Fig. 4.7, "triangulation samples" [T-73].

    Example:
        >>> import jax, jax.numpy as jnp, jaxloc as jl
        >>> belief = jl.beliefs.Gaussian(jnp.array([2.0]), jnp.array([[0.01]]))
        >>> image = jl.beliefs.propagate_sampled(jnp.square, belief, key=jax.random.key(0), num_samples=4096)
        >>> bool(jnp.abs(image.mean[0] - 4.01) < 0.05)
        True
    """
    if num_samples < 2:
        raise ValueError(f"propagate_sampled needs at least 2 samples; it got {num_samples}.")
    dtype = gaussian.covariance.dtype
    normal = jax.random.normal(key, (num_samples, gaussian.dimension), dtype)
    samples = _evaluate(f, gaussian, matmul(normal, cholesky(gaussian.covariance).T))
    weights = jnp.full(num_samples, 1.0 / num_samples, dtype)
    return _moments(samples, f(gaussian.mean), weights, weights * (num_samples / (num_samples - 1)))


def _evaluate(f: Callable[[Any], Any], gaussian: Gaussian, deltas: Float[Array, "k d"]) -> Any:
    return jax.vmap(lambda delta: f(retract(gaussian.mean, delta)))(deltas)


def _moments(
    samples: Any, initial: Any, weights: Float[Array, " k"], weights_covariance: Float[Array, " k"]
) -> Gaussian:
    """Intrinsic mean of weighted samples, from an initial value near it, and the covariance about it."""
    center = initial
    for _ in range(1 if is_flat(initial) else _MEAN_STEPS):
        center = retract(center, jnp.sum(weights[:, None] * _deviations(center, samples), axis=0))
    deviations = _deviations(center, samples)
    return Gaussian(center, matmul(deviations.T, weights_covariance[:, None] * deviations))


def _deviations(center: Any, samples: Any) -> Float[Array, "k d"]:
    return jax.vmap(lambda sample: local(center, sample))(samples)
