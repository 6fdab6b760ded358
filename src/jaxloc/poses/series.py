"""Trigonometric coefficients of exponential maps, exact and smooth at zero angle.

Each is an even function of the angle, so it takes the squared angle ``s``: no square root is differentiated at zero.
Below ``s = 0.25`` a Taylor series is used (its truncation error is under 1e-17), above it the closed form; the argument
of the branch not taken is replaced by a safe one, so that derivatives of any order stay finite.
"""

from collections.abc import Callable
from math import factorial

import jax.numpy as jnp
from jaxtyping import Array, Float

Scalar = Float[Array, ""]

_SWITCH = 0.25
_TERMS = range(9)

_SINC = tuple((-1) ** k / factorial(2 * k + 1) for k in _TERMS)
_VERSINE = tuple((-1) ** k / factorial(2 * k + 2) for k in _TERMS)
_THIRD = tuple((-1) ** k / factorial(2 * k + 3) for k in _TERMS)
_FOURTH = tuple((-1) ** k / factorial(2 * k + 4) for k in _TERMS)
_FIFTH = tuple((-1) ** k * (k + 1) / factorial(2 * k + 5) for k in _TERMS)
# |B_2k| / (2k)! of the Bernoulli numbers.
_COTANGENT = (
    1 / 12,
    1 / 720,
    1 / 30240,
    1 / 1209600,
    1 / 47900160,
    691 / 1307674368000,
    1 / 74724249600,
    3617 / 10670622842880000,
)


def _polynomial(coefficients: tuple[float, ...], s: Scalar) -> Scalar:
    value = jnp.full_like(s, coefficients[-1])
    for coefficient in reversed(coefficients[:-1]):
        value = value * s + coefficient
    return value


def _branch(coefficients: tuple[float, ...], closed: Callable[[Scalar, Scalar], Scalar], s: Scalar) -> Scalar:
    small = s < _SWITCH
    near = _polynomial(coefficients, jnp.where(small, s, 0.0))
    far = jnp.where(small, 1.0, s)
    return jnp.where(small, near, closed(jnp.sqrt(far), far))


def sinc(s: Scalar) -> Scalar:
    """``sin(a) / a`` of the squared angle ``s = a^2``."""
    return _branch(_SINC, lambda a, s: jnp.sin(a) / a, s)


def versine(s: Scalar) -> Scalar:
    """``(1 - cos(a)) / a^2`` of the squared angle ``s = a^2``."""
    return _branch(_VERSINE, lambda a, s: 2.0 * jnp.sin(0.5 * a) ** 2 / s, s)


def third(s: Scalar) -> Scalar:
    """``(a - sin(a)) / a^3`` of the squared angle ``s = a^2``."""
    return _branch(_THIRD, lambda a, s: (1.0 - jnp.sin(a) / a) / s, s)


def fourth(s: Scalar) -> Scalar:
    """``(a^2 / 2 + cos(a) - 1) / a^4`` of the squared angle ``s = a^2``."""
    return _branch(_FOURTH, lambda a, s: (0.5 - 2.0 * jnp.sin(0.5 * a) ** 2 / s) / s, s)


def fifth(s: Scalar) -> Scalar:
    """``(2 a - 3 sin(a) + a cos(a)) / (2 a^5)`` of the squared angle ``s = a^2``."""
    return _branch(_FIFTH, lambda a, s: (2.0 - 3.0 * jnp.sin(a) / a + jnp.cos(a)) / (2.0 * s * s), s)


def cotangent(s: Scalar) -> Scalar:
    """``(1 - (a / 2) cot(a / 2)) / a^2`` of the squared angle ``s = a^2``; finite up to ``a = 2 pi``."""
    return _branch(_COTANGENT, lambda a, s: (1.0 - 0.5 * a * jnp.cos(0.5 * a) / jnp.sin(0.5 * a)) / s, s)
