"""Resampling schemes: systematic, stratified, multinomial, residual and soft, as indices in linear time."""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int, Key

from jaxloc.beliefs.particles import NOTHING, Particles
from jaxloc.beliefs.resampling.cumulative_weights import Boundaries, boundaries, bounded_values

_ROUNDING = 1.2e-7  # of single precision


def systematic(
    key: Key[Array, ""], log_weights: Float[Array, " m"], n: int, *, count: Int[Array, ""] | None = None
) -> Int[Array, " n"]:
    """Ancestors at the points ``(j + u) / n`` of the cumulative weights, one random number for all.

    The number of copies of a particle is ``n w`` rounded down or up, and ``n w`` on average. The cumulative sum is in
    integers: exact for millions of particles, and the same for any sharding over devices.

    Args:
        key: random key.
        log_weights: of any common offset; non-finite weights count as zero; where all are zero, all are equal.
        n: number of ancestors drawn.
        count: number to draw; the rest of the ancestors is undefined. None for n.

    Returns:
        Indices in ascending order; they carry no gradient (see `Systematic` for the weights that do).

    References:
        Carpenter, Clifford, Fearnhead, "Improved particle filter for nonlinear problems", IEE Proc. 1999 [R-10]; Douc,
        Cappe, Moulines, "Comparison of resampling schemes for particle filtering", ISPA 2005.

    Example:
        >>> import jax, jax.numpy as jnp, jaxloc as jl
        >>> log_weights = jnp.log(jnp.array([0.5, 0.0, 0.25, 0.25]))
        >>> jl.beliefs.resampling.systematic(jax.random.key(0), log_weights, 4).tolist()
        [0, 0, 2, 3]
    """
    bounds = boundaries(bounded_values(log_weights), _count(n, count))
    offset = jax.random.bits(key, (), jnp.uint32)
    return _ancestors(bounds.whole + (bounds.fraction > offset).astype(jnp.int32), bounds.last, n)


def stratified(
    key: Key[Array, ""], log_weights: Float[Array, " m"], n: int, *, count: Int[Array, ""] | None = None
) -> Int[Array, " n"]:
    """Ancestors at the points ``(j + u_j) / n`` of the cumulative weights, a random number for each.

    Args:
        key: random key.
        log_weights: as for `systematic`.
        n: number of ancestors drawn.
        count: draw only so many.

    Returns:
        Indices in ascending order.

    References:
        Kitagawa, "Monte Carlo filter and smoother for non-Gaussian nonlinear state space models", JCGS 1996 [R-10].

    Example:
        >>> import jax, jax.numpy as jnp, jaxloc as jl
        >>> jl.beliefs.resampling.stratified(jax.random.key(0), jnp.zeros(4), 4).tolist()
        [0, 1, 2, 3]
    """
    bounds = boundaries(bounded_values(log_weights), _count(n, count))
    offsets = jax.random.bits(key, (n,), jnp.uint32)
    offset = offsets.at[jnp.clip(bounds.whole, 0, n - 1)].get(mode="promise_in_bounds")
    return _ancestors(bounds.whole + (bounds.fraction > offset).astype(jnp.int32), bounds.last, n)


def multinomial(
    key: Key[Array, ""], log_weights: Float[Array, " m"], n: int, *, count: Int[Array, ""] | None = None
) -> Int[Array, " n"]:
    """Independent ancestors, each particle with its weight's probability.

    Uniform points are drawn as (cell, fraction) of n cells; how many lie in each cell is counted, and those before each
    boundary are compared one by one within its own cell, which holds about one: no sort and no search.

    Args:
        key: random key.
        log_weights: as for `systematic`.
        n: number of ancestors drawn.
        count: draw only so many.

    Returns:
        Indices in ascending order (shuffle them where order matters).

    References:
        Gordon, Salmond, Smith, 1993 [R-10].

    Example:
        >>> import jax, jax.numpy as jnp, jaxloc as jl
        >>> log_weights = jnp.log(jnp.array([0.5, 0.0, 0.5]))
        >>> bool(jnp.any(jl.beliefs.resampling.multinomial(jax.random.key(0), log_weights, 100) == 1))
        False
    """
    bounds = boundaries(bounded_values(log_weights), _count(n, count))
    return _ancestors(_points_below(key, bounds, n, _count(n, count)), bounds.last, n)


def residual(
    key: Key[Array, ""], log_weights: Float[Array, " m"], n: int, *, count: Int[Array, ""] | None = None
) -> Int[Array, " n"]:
    """The whole part of ``n w`` copies of each particle, and independent draws from what remains.

    Args:
        key: random key.
        log_weights: as for `systematic`.
        n: number of ancestors drawn.
        count: draw only so many.

    Returns:
        Indices in ascending order.

    References:
        Liu and Chen, "Sequential Monte Carlo methods for dynamic systems", JASA 1998 [R-10].

    Example:
        >>> import jax, jax.numpy as jnp, jaxloc as jl
        >>> log_weights = jnp.log(jnp.array([0.5, 0.125, 0.375]))
        >>> jl.beliefs.resampling.residual(jax.random.key(0), log_weights, 8).tolist()
        [0, 0, 0, 0, 1, 2, 2, 2]
    """
    total = _count(n, count)
    bounds = boundaries(bounded_values(log_weights), total)
    # A share within rounding of an integer counts as that integer.
    copies = jnp.floor(bounds.share * (1.0 + 4.0 * _ROUNDING)).astype(jnp.int32)
    missing = jnp.maximum(total - jnp.sum(copies, dtype=jnp.int32), 0)
    rest = boundaries(jnp.maximum(bounds.share - copies.astype(jnp.float32), 0.0), missing)
    drawn = _points_below(key, rest, n, missing)
    return _ancestors(jnp.cumsum(copies, axis=0, dtype=jnp.int32) + drawn, bounds.last, n)


def soft(
    key: Key[Array, ""],
    log_weights: Float[Array, " m"],
    n: int,
    *,
    alpha: float = 0.5,
    scheme: Callable[..., Int[Array, " n"]] = systematic,
) -> tuple[Int[Array, " n"], Float[Array, " n"]]:
    """Ancestors from the mixture ``q = a w + (1 - a) / m``, with log weights ``log(w / q / n)`` that carry gradients.

    The gradient is biased. Weights, estimates and the likelihood are unbiased (with more variance than `systematic`);
    but no derivative passes through the choice of ancestors, which biases the score by a part that vanishes as ``a``
    goes to zero, where nothing is resampled.

    Args:
        key: random key.
        log_weights: as for `systematic`.
        n: number of ancestors drawn.
        alpha: part of the weights in the mixture, in (0, 1].
        scheme: resampling scheme.

    Returns:
        Indices, and the log weights of the drawn particles.

    References:
        Karkus, Hsu, Lee, "Particle filter networks", CoRL 2018, eq. 5.

    Example:
        >>> import jax, jax.numpy as jnp, jaxloc as jl
        >>> log_weights = jnp.log(jnp.array([0.5, 0.3, 0.2]))
        >>> indices, fresh = jl.beliefs.resampling.soft(jax.random.key(0), log_weights, 1000)
        >>> bool(jnp.abs(jnp.sum(jnp.exp(fresh)) - 1.0) < 0.02)
        True
    """
    if not 0.0 < alpha <= 1.0:
        raise ValueError(f"soft resampling needs 0 < alpha <= 1; it got {alpha}.")
    normal = Particles(log_weights, log_weights).normalize().log_weights
    there = normal > 0.5 * NOTHING
    uniform = -jnp.log(jnp.maximum(jnp.sum(there), 1).astype(normal.dtype)) + math.log(max(1.0 - alpha, 1e-30))
    mixed = jnp.where(there, jnp.logaddexp(jnp.where(there, normal, 0.0) + math.log(alpha), uniform), NOTHING)
    indices = scheme(key, mixed, n)
    fresh = jnp.where(there, normal - mixed, NOTHING)
    return indices, fresh.at[indices].get(mode="promise_in_bounds") - math.log(n)


def _count(n: int, count: Array | None) -> Array:
    return jnp.asarray(n, jnp.int32) if count is None else jnp.clip(count, 1, n).astype(jnp.int32)


def _ancestors(below: Array, last: Array, n: int) -> Array:
    """Index of the particle in whose share each of n points lies: the number of boundaries at or before it.

    Args:
        below: for each particle, the number of points before the end of its share.
        last: the last particle of nonzero weight.
        n: number of points.
    """
    ends = jnp.zeros(n + 1, jnp.int32).at[jnp.clip(below, 0, n)].add(1, mode="promise_in_bounds")
    return jnp.minimum(jnp.cumsum(ends[:n], axis=0, dtype=jnp.int32), last)


def _points_below(key: Array, bounds: Boundaries, n: int, count: Array) -> Array:
    """Number of `count` independent uniform points before each boundary."""
    key_cell, key_fraction = jax.random.split(key)
    cells = jax.random.randint(key_cell, (n,), 0, jnp.maximum(count, 1), jnp.int32)
    used = (jnp.arange(n, dtype=jnp.int32) < count).astype(jnp.int32)
    load = jnp.zeros(n + 1, jnp.int32).at[cells].add(used, mode="promise_in_bounds")
    first = jnp.cumsum(load, axis=0, dtype=jnp.int32) - load
    fractions = jax.random.bits(key_fraction, (n,), jnp.uint32)
    cell = jnp.clip(bounds.whole, 0, n)
    cell_first, cell_load = (x.at[cell].get(mode="promise_in_bounds") for x in (first, load))

    def compare(carry):
        place, found = carry
        point = fractions.at[jnp.minimum(cell_first + place, n - 1)].get(mode="promise_in_bounds")
        return place + 1, found + ((place < cell_load) & (point < bounds.fraction)).astype(jnp.int32)

    most = jnp.max(load)
    initial = (jnp.zeros((), jnp.int32), cell_first)
    return lax.while_loop(lambda carry: carry[0] < most, compare, initial)[1]
