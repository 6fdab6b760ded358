"""Chi-square distribution and gates of squared Mahalanobis distances."""

from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy.special import gammainc, gammaincc, gammaln, ndtri
from jaxtyping import Array, Bool, Float

from jaxloc._jit import filter_jit
from jaxloc.poses.lie_group import as_floats

_NEWTON_STEPS = 12


def chi2_cdf(x: Any, dof: Any) -> Float[Array, "*n"]:
    """Cumulative distribution function of the chi-square distribution: ``P(dof / 2, x / 2)``.

    Args:
        x: squared distance or an array of them.
        dof: number of degrees of freedom (scalar, or as x); no gradient passes through it.

    Returns:
        Probability, shaped as x.

    References:
        Abramowitz and Stegun, 26.4.19 [T-89].

    Example:
        >>> import jaxloc as jl
        >>> round(float(jl.beliefs.chi2_cdf(7.815, 3)), 3)
        0.95
    """
    return _cdf(*as_floats(x, dof))


def chi2_quantile(probability: Any, dof: Any) -> Float[Array, "*n"]:
    """Quantile of the chi-square distribution.

    Newton steps on the logarithm of the smaller tail over the logarithm of x (a concave function), from the
    Wilson-Hilferty approximation; the derivative is that of the implicit function.

    Args:
        probability: scalar or array, clipped to [0, 1) by one unit of rounding.
        dof: number of degrees of freedom (scalar, or as the probability); no gradient passes through it.

    Returns:
        Quantile, shaped as the probability.

    References:
        Wilson and Hilferty, "The distribution of chi-square", PNAS 1931 [T-89].

    Example:
        >>> import jaxloc as jl
        >>> round(float(jl.beliefs.chi2_quantile(0.95, 3)), 2)
        7.81
    """
    return _quantile(*as_floats(probability, dof))


def gate(mahalanobis_squared: Float[Array, "*n"], dof: Any, probability: Any) -> Bool[Array, "*n"]:
    """Chi-square gate: whether squared distances lie below the quantile of a probability.

    Args:
        mahalanobis_squared: squared Mahalanobis distances; NaN lies outside.
        dof: number of degrees of freedom of the residual.
        probability: of the gate, such as 0.99. Python numbers are evaluated at trace time.

    Returns:
        Booleans, shaped as the distances.

    References:
        Bar-Shalom and Li, *Multitarget-Multisensor Tracking*, 1995, section 2.3 [T-89].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> jl.beliefs.gate(jnp.array([7.0, 8.0]), dof=3, probability=0.95).tolist()
        [True, False]
    """
    if isinstance(dof, int | float) and isinstance(probability, int | float):
        with jax.ensure_compile_time_eval():
            threshold: Any = float(chi2_quantile(probability, dof))
    else:
        threshold = chi2_quantile(probability, dof).astype(mahalanobis_squared.dtype)
    return mahalanobis_squared <= threshold


@filter_jit
def _cdf(x: Array, dof: Array) -> Array:
    return gammainc(0.5 * lax.stop_gradient(dof), 0.5 * jnp.maximum(x, 0.0))


@filter_jit
def _quantile(probability: Array, dof: Array) -> Array:
    info = jnp.finfo(probability.dtype)
    probability = jnp.clip(probability, float(info.tiny) ** 0.5, 1.0 - float(info.eps))
    p, k = lax.stop_gradient((probability, dof))
    upper = p > 0.5

    def density(x):
        return jnp.exp((0.5 * k - 1.0) * jnp.log(0.5 * x) - 0.5 * x - gammaln(0.5 * k)) * 0.5

    def improve(_, log_x):
        x = jnp.exp(log_x)
        mass = jnp.maximum(jnp.where(upper, gammaincc(0.5 * k, 0.5 * x), gammainc(0.5 * k, 0.5 * x)), float(info.tiny))
        slope = jnp.maximum(x * density(x) / mass, float(info.eps))
        step = (jnp.log(jnp.where(upper, 1.0 - p, p)) - jnp.log(mass)) / slope
        return log_x + jnp.clip(jnp.where(upper, -step, step), -2.0, 2.0)

    tail = 2.0 * jnp.exp((jnp.log(p) + gammaln(0.5 * k + 1.0)) * 2.0 / k)
    central = k * jnp.maximum(1.0 - 2.0 / (9.0 * k) + ndtri(p) * jnp.sqrt(2.0 / (9.0 * k)), 0.0) ** 3
    initial = jnp.log(jnp.maximum(central, 0.5 * tail) + float(info.tiny))
    x = jnp.exp(lax.fori_loop(0, _NEWTON_STEPS, improve, initial))
    return x + (probability - p) / jnp.maximum(density(x), float(info.tiny))
