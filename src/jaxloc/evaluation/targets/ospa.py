"""OSPA, GOSPA and OSPA(2) distances between sets of targets.

Sets are padded: values with a mask. Estimates come first, truth second. Points that are not finite, or so far away that
their distance is not, count and match none. A cutoff that is no positive number, or whose power is beyond what the
dtype holds, gives ``ok`` False, finite distances and no gradients.

References:
    Schuhmacher, Vo and Vo, "A consistent metric for performance evaluation of multi-object filters", IEEE TSP 2008.
    Rahmathullah, Garcia-Fernandez and Svensson, "Generalized optimal sub-pattern assignment metric", FUSION 2017.
    Beard, Vo and Vo, "OSPA(2): using the OSPA metric to evaluate multi-target tracking performance", ICCAIS 2017.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxloc._jit import filter_jit
from jaxloc.solvers import assign


class Ospa(eqx.Module):
    """An OSPA distance: ``distance^p = localization^p + cardinality^p``.

    Attributes:
        distance: in the units of the cutoff, between zero and it.
        localization: part of the errors of matched targets; pairs farther apart than the cutoff count as it.
        cardinality: part of the difference in number.
        ok: whether the cutoff is one; without it the distance means nothing.
    """

    distance: Float[Array, "*t"]
    localization: Float[Array, "*t"]
    cardinality: Float[Array, "*t"]
    ok: Bool[Array, "*t"]


class Gospa(eqx.Module):
    """A GOSPA distance: ``distance^p = localization + missed + false``.

    Attributes:
        distance: in the units of the cutoff.
        localization: sum of the errors of matched targets, to the power p.
        missed: what true targets cost that are matched to none.
        false: what estimates cost that are matched to none.
        num_missed: how many.
        num_false: how many.
        ok: whether cutoff and alpha are within their bounds; without that the distance means nothing.
    """

    distance: Float[Array, ""]
    localization: Float[Array, ""]
    missed: Float[Array, ""]
    false: Float[Array, ""]
    num_missed: Int[Array, ""]
    num_false: Int[Array, ""]
    ok: Bool[Array, ""]


class _Match(eqx.Module):
    """The best matching: its cost without those left over, its pairs, and the sizes of both sets."""

    cost: Float[Array, ""]
    pairs: Int[Array, ""]
    size_x: Int[Array, ""]
    size_y: Int[Array, ""]


def ospa(
    x: Float[Array, "n d"],
    valid_x: Bool[Array, " n"],
    y: Float[Array, "m d"],
    valid_y: Bool[Array, " m"],
    *,
    cutoff: float | Float[Array, ""],
    order: float = 1.0,
) -> Ospa:
    """The OSPA distance of two sets of points: the error of a target on average, where a missing one costs the cutoff.

    ``(1/n min_pi sum_i min(d_i, c)^p + c^p |n - m| / n)^(1/p)``, where n is the larger number; zero for two empty sets.
    Above order one, Stone Soup's figure can be larger: it matches by the distances, not by their powers.

    Args:
        x: estimates; non-finite ones count, and match none.
        valid_x: which there are.
        y: true points.
        valid_y: which there are.
        cutoff: c, largest error of a target.
        order: p, at least one.

    Returns:
        The distance and its parts. Gradients are those of the matching that is best.

    References:
        Schuhmacher et al. 2008, eq. 3. [T-65]

    Example:
        >>> import jax.numpy as jnp
        >>> x, y = jnp.array([[0.0, 0.0], [9.0, 9.0]]), jnp.array([[3.0, 4.0]])
        >>> found = ospa(x, jnp.array([True, True]), y, jnp.array([True]), cutoff=10.0)
        >>> float(found.distance), float(found.localization), float(found.cardinality)
        (7.5, 2.5, 5.0)
    """
    return _ospa(x, valid_x, y, valid_y, jnp.asarray(cutoff, x.dtype), _at_least_one(order))


@filter_jit
def _ospa(x: Array, valid_x: Array, y: Array, valid_y: Array, cutoff: Array, order: float) -> Ospa:
    cutoff, ok = _usable_cutoff(cutoff, order)
    match = _match(_distances(x, y, cutoff, order), valid_x, valid_y, cutoff**order)
    return _ospa_of(match, cutoff, order, ok)


def gospa(
    x: Float[Array, "n d"],
    valid_x: Bool[Array, " n"],
    y: Float[Array, "m d"],
    valid_y: Bool[Array, " m"],
    *,
    cutoff: float | Float[Array, ""],
    order: float = 2.0,
    alpha: float | Float[Array, ""] = 2.0,
) -> Gospa:
    """The GOSPA distance of two sets of points: localization, missed and false targets add up.

    ``(min_pi sum_i min(d_i, c)^p + c^p / alpha |n - m|)^(1/p)``; with alpha 2, each missed or false target costs
    ``c^p / 2``.

    Args:
        x: estimates; non-finite ones count, and match none.
        valid_x: which there are.
        y: true points.
        valid_y: which there are.
        cutoff: c, error beyond which two points are no match.
        order: p, at least one.
        alpha: above zero (1e-6), at most two.

    Returns:
        The distance and its parts. Gradients are those of the matching that is best.

    References:
        Rahmathullah et al. 2017, definition 1 and proposition 1. [T-65]

    Example:
        >>> import jax.numpy as jnp
        >>> x, y = jnp.array([[0.0, 0.0], [9.0, 9.0]]), jnp.array([[3.0, 4.0]])
        >>> found = gospa(x, jnp.array([True, True]), y, jnp.array([True]), cutoff=10.0)
        >>> float(found.localization), float(found.missed), float(found.false), int(found.num_false)
        (25.0, 0.0, 50.0, 1)
    """
    limits = jnp.asarray(cutoff, x.dtype), jnp.asarray(alpha, x.dtype)
    return _gospa(x, valid_x, y, valid_y, *limits, _at_least_one(order))


@filter_jit
def _gospa(x: Array, valid_x: Array, y: Array, valid_y: Array, cutoff: Array, alpha: Array, order: float) -> Gospa:
    cutoff, ok = _usable_cutoff(cutoff, order)
    bounded = (alpha >= 1e-6) & (alpha <= 2.0)
    ok, alpha = ok & bounded, jnp.where(bounded, alpha, 2.0)
    limit = cutoff**order
    match = _match(_distances(x, y, cutoff, order), valid_x, valid_y, limit)
    both = jnp.minimum(match.size_x, match.size_y)

    def left_over(size: Array) -> Array:
        # A pair that is too far apart costs each side half; who is alone because the other set is smaller, 1 / alpha.
        pairs, alone = (number.astype(x.dtype) for number in (both - match.pairs, size - both))
        return limit * (0.5 * pairs + alone / alpha)

    missed, false = left_over(match.size_y), left_over(match.size_x)
    total = match.cost + missed + false
    numbers = match.size_y - match.pairs, match.size_x - match.pairs
    return Gospa(_power(total, 1.0 / order), match.cost, missed, false, *numbers, ok)


def ospa2(
    x: Float[Array, "n t d"],
    valid_x: Bool[Array, "n t"],
    y: Float[Array, "m t d"],
    valid_y: Bool[Array, "m t"],
    *,
    cutoff: float | Float[Array, ""],
    window: int,
    order: float = 1.0,
) -> Ospa:
    """The OSPA(2) distance of two sets of tracks over a sliding window, which penalizes identity switches and breaks.

    The distance of two tracks is their error on average over the instants at which either is there; where only one is,
    it is the cutoff. The distance of the sets is the OSPA distance in that measure.

    Args:
        x: estimated tracks, by identity and time.
        valid_x: where they are there.
        y: true tracks.
        valid_y: where they are there.
        cutoff: c, largest error at an instant.
        window: how many instants up to each.
        order: p, of both averages; at least one.

    Returns:
        The distance and its parts at each instant, over the window that ends there.

    References:
        Beard et al. 2017, eq. 9-11. [T-65]

    Example:
        >>> import jax.numpy as jnp
        >>> truth, there = jnp.array([[[0.0], [0.0], [0.0], [0.0]]]), jnp.ones((1, 4), bool)
        >>> broken = jnp.array([[True, True, False, False], [False, False, True, True]])
        >>> found = ospa2(jnp.zeros((2, 4, 1)), broken, truth, there, cutoff=8.0, window=4)
        >>> found.distance.tolist()
        [0.0, 0.0, 5.333333492279053, 6.0]
    """
    if window < 1:
        raise ValueError(f"A window holds at least 1 instant; it got {window}.")
    return _ospa2(x, valid_x, y, valid_y, jnp.asarray(cutoff, x.dtype), window, _at_least_one(order))


@filter_jit
def _ospa2(x: Array, valid_x: Array, y: Array, valid_y: Array, cutoff: Array, window: int, order: float) -> Ospa:
    cutoff, ok = _usable_cutoff(cutoff, order)
    limit = cutoff**order
    errors = jax.vmap(lambda a, b: _distances(a, b, cutoff, order), in_axes=(1, 1), out_axes=2)(x, y)
    one, other = valid_x[:, None], valid_y[None]
    both = one & other & jnp.isfinite(errors)
    errors = jnp.where(both, jnp.minimum(jnp.where(both, errors, 0.0), limit), jnp.where(one | other, limit, 0.0))
    instants = _sliding((one | other).astype(x.dtype), window)
    means = _sliding(errors, window) / jnp.maximum(instants, 1.0)
    seen_x, seen_y = (_sliding(valid.astype(x.dtype), window) > 0 for valid in (valid_x, valid_y))

    def at(mean: Array, here_x: Array, here_y: Array) -> Ospa:
        return _ospa_of(_match(mean, here_x, here_y, limit), cutoff, order, ok)

    return jax.vmap(at, in_axes=(2, 1, 1))(means, seen_x, seen_y)


def _usable_cutoff(cutoff: Float[Array, ""], order: float) -> tuple[Float[Array, ""], Bool[Array, ""]]:
    """The cutoff, or the nearest one that can be used, without derivatives; and whether it is its own."""
    numbers = jnp.finfo(cutoff.dtype)
    # Room for sums of a million errors, also divided by the least alpha.
    lowest, highest = (float(bound) ** (1.0 / order) for bound in (numbers.tiny, numbers.max * 1e-14))
    ok = (cutoff >= lowest) & (cutoff <= highest)
    return jnp.where(ok, cutoff, jnp.where(cutoff > highest, highest, 0.0)), ok


def _distances(
    x: Float[Array, "n d"], y: Float[Array, "m d"], cutoff: Float[Array, ""], order: float
) -> Float[Array, "n m"]:
    """Euclidean distances to a power; infinite where a number is not finite, or well above the cutoff."""
    # Squares of larger numbers overflow.
    largest = 1e-3 * float(jnp.finfo(x.dtype).max) ** 0.5
    finite = [jnp.all(jnp.abs(points) < largest, axis=1) for points in (x, y)]
    both = finite[0][:, None] & finite[1][None]
    gaps = jnp.where(both[..., None], x[:, None], 0.0) - jnp.where(both[..., None], y[None], 0.0)
    squared = jnp.sum(gaps**2, axis=-1)
    # No power of a distance that does not matter, whose derivative could overflow.
    near = both & (squared < 2.0 * lax.stop_gradient(cutoff) ** 2)
    return jnp.where(near, _power(jnp.where(near, squared, 0.0), 0.5 * order), jnp.inf)


def _match(costs: Float[Array, "n m"], valid_x: Array, valid_y: Array, limit: Float[Array, ""]) -> _Match:
    """The matching for which the pairs' costs and a limit for each pair less is least."""
    allowed = valid_x[:, None] & valid_y[None] & (costs < limit)
    columns = assign(costs, allowed, unassigned=jnp.where(valid_x, limit, 0.0)).columns
    taken = columns >= 0
    safe = jnp.where(allowed, costs, 0.0)
    picked = jnp.take_along_axis(safe, jnp.maximum(columns, 0)[:, None], axis=1)[:, 0]
    sizes = (jnp.sum(mask, dtype=jnp.int32) for mask in (taken, valid_x, valid_y))
    return _Match(jnp.sum(jnp.where(taken, picked, 0.0)), *sizes)


def _ospa_of(match: _Match, cutoff: Float[Array, ""], order: float, ok: Bool[Array, ""]) -> Ospa:
    dtype = cutoff.dtype
    fewer, more = jnp.minimum(match.size_x, match.size_y), jnp.maximum(match.size_x, match.size_y)
    size = jnp.maximum(more, 1).astype(dtype)
    limit = cutoff**order
    near = (match.cost + limit * (fewer - match.pairs).astype(dtype)) / size
    number = limit * (more - fewer).astype(dtype) / size
    return Ospa(*(_power(part, 1.0 / order) for part in (near + number, near, number)), ok)


def _power(value: Array, exponent: float) -> Array:
    """A power of something not negative, whose derivative at zero is zero."""
    positive = value > 0
    return jnp.where(positive, jnp.where(positive, value, 1.0) ** exponent, 0.0)


def _sliding(values: Float[Array, "*k t"], window: int) -> Float[Array, "*k t"]:
    """Sums over the last instants up to each."""
    leading = values.ndim - 1
    sizes, before = (1,) * leading + (window,), ((0, 0),) * leading + ((window - 1, 0),)
    return lax.reduce_window(values, np.zeros((), values.dtype), lax.add, sizes, (1,) * values.ndim, before)


def _at_least_one(order: Any) -> float:
    if not order >= 1:
        raise ValueError(f"The order of a metric is at least 1; it got {order}.")
    return float(order)
