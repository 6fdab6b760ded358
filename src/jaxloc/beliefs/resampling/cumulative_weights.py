"""Cumulative weights in fixed point: exact for any number of particles, in any order of summation."""

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int, UInt32

_FRACTION = 4294967296.0  # 2^32


class Boundaries(eqx.Module):
    """Cumulative sums ``C_i = whole + fraction / 2^32`` of shares that add up to a count.

    Attributes:
        whole: integer part.
        fraction: in units of ``2^-32``.
        share: each one's own share, rounded to single precision.
        last: the last index with a share.
    """

    whole: Int[Array, " m"]
    fraction: UInt32[Array, " m"]
    share: Float[Array, " m"]
    last: Int[Array, ""]


def bounded_values(log_weights: Float[Array, " m"]) -> Float[Array, " m"]:
    """Weights over the largest one, in single precision; equal ones where all are zero or non-finite.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> jl.beliefs.resampling.cumulative_weights.bounded_values(jnp.array([5.0, jnp.nan, -jnp.inf])).tolist()
        [1.0, 0.0, 0.0]
    """
    log_weights = lax.stop_gradient(log_weights)
    good = (log_weights > -jnp.inf) & (log_weights < jnp.inf)
    top = jnp.max(jnp.where(good, log_weights, -jnp.inf))
    values = jnp.exp(jnp.where(good, log_weights - jnp.where(top > -jnp.inf, top, 0.0), -jnp.inf))
    return jnp.where(top > -jnp.inf, values, 1.0).astype(jnp.float32)


def boundaries(values: Float[Array, " m"], count: Int[Array, ""]) -> Boundaries:
    """Cumulative sums of ``count v_i / sum v`` in 64-bit fixed point, made of two 32-bit integers.

    In single precision a cumulative sum of 1e6 shares is off by whole shares. Here each share is split into its integer
    part and a fraction of 32 bits; the fractions are added with wrap-around, which occurred wherever a sum is less than
    its last term, and the carries are added to the integer parts. Integer sums do not depend on their order, so that
    particles sharded over devices give the same numbers. The rounding error of the total is distributed in
    proportion.

    Args:
        values: in [0, 1], with the largest near 1, single precision.
        count: sum of the shares.

    Returns:
        The cumulative sums, whose last one is the count to ``2^-24`` of a share.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> bounds = jl.beliefs.resampling.cumulative_weights.boundaries(jnp.array([1.0, 0.5, 0.5]), jnp.array(3))
        >>> bounds.whole.tolist(), bounds.fraction.tolist()
        ([1, 2, 3], [2147483648, 1073741824, 0])
    """
    target = count.astype(jnp.float32)
    total = _total(values)
    share = jnp.minimum(values * (target / jnp.where(total > 0, total, 1.0)), target)
    own_whole, own_fraction = _split(share)
    fraction = jnp.cumsum(own_fraction, axis=0, dtype=jnp.uint32)
    whole = jnp.cumsum(own_whole + (fraction < own_fraction).astype(jnp.int32), axis=0, dtype=jnp.int32)
    # The total missed the count by the rounding of the shares: each sum takes its part of that.
    missing = (count - whole[-1]).astype(jnp.float32) - fraction[-1].astype(jnp.float32) / _FRACTION
    total = target - missing
    sums = whole.astype(jnp.float32) + fraction.astype(jnp.float32) / _FRACTION
    extra_whole, extra = _split(sums * (missing / jnp.where(total > 0, total, 1.0)))
    fraction = fraction + extra
    whole = whole + extra_whole + (fraction < extra).astype(jnp.int32)
    last = jnp.max(jnp.where(values > 0, jnp.arange(values.shape[0], dtype=jnp.int32), 0))
    return Boundaries(whole, fraction, share, last)


def _split(numbers: Array) -> tuple[Array, Array]:
    floor = jnp.floor(numbers)
    return floor.astype(jnp.int32), ((numbers - floor) * _FRACTION).astype(jnp.uint32)


def _total(values: Array) -> Array:
    """Sum of values in [0, 1] in three integer digits: accurate, and the same in any order of summation."""
    unit = 2.0 ** (31 - values.shape[0].bit_length())
    total, scale, rest = jnp.zeros((), jnp.float32), 1.0, jnp.minimum(values, 1.0)
    for _ in range(3):
        digit = jnp.floor(rest * unit)
        rest, scale = rest * unit - digit, scale / unit
        total = total + scale * jnp.sum(digit.astype(jnp.int32), dtype=jnp.int32).astype(jnp.float32)
    return total
