"""Extrema of a stack of filter responses over position and scale, with subpixel refinement."""

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxloc._jit import filter_jit

_MOVES = 5


class Extrema(eqx.Module):
    """Extrema of a stack of responses.

    Attributes:
        place: interpolated position (layer, row, column), differentiable.
        value: response there.
        valid: which slots hold one.
    """

    place: Float[Array, "n 3"]
    value: Float[Array, " n"]
    valid: Bool[Array, " n"]


class ExtremumTest(eqx.Module):
    """Criteria of an extremum.

    Attributes:
        least_value: least absolute response between samples; half of it at a sample.
        edge_ratio: greatest ratio of principal curvatures in the image.
        border: width of the margin without extrema, samples.
        minima: whether minima count as well as maxima.
        within_layer: extrema among the 8 neighbors of the same layer, without refinement over scale; first and last
            layer included.
    """

    least_value: float | Float[Array, ""]
    edge_ratio: float | Float[Array, ""] = 10.0
    border: int = eqx.field(static=True, default=5)
    minima: bool = eqx.field(static=True, default=True)
    within_layer: bool = eqx.field(static=True, default=False)


@filter_jit
def find_extrema(stack: Float[Array, "s h w"], test: ExtremumTest, *, capacity: int) -> Extrema:
    """Extrema among 26 neighbors, refined by a quadratic model, without low contrast and edges.

    Args:
        stack: responses over layer, row and column.
        test: criteria.
        capacity: slots; the strongest samples are kept.

    Returns:
        The extrema, strongest sample first.

    References:
        Thesis section 2.2.2: 26 neighbors [T-29], second-order Taylor expansion (eq. 2.33) [T-30], contrast [T-31],
        ratio of curvatures by trace and determinant (eq. 2.34) [T-32]; Brown and Lowe, BMVC 2002.

    Example:
        >>> import jax.numpy as jnp
        >>> s, v, u = jnp.meshgrid(jnp.arange(5.0), jnp.arange(15.0), jnp.arange(15.0), indexing="ij")
        >>> bump = 9.0 - (s - 2.2) ** 2 - (v - 7.3) ** 2 - (u - 6.9) ** 2
        >>> found = find_extrema(bump, ExtremumTest(1.0), capacity=4)
        >>> found.valid.tolist(), [round(float(x), 2) for x in found.place[0]]
        ([True, False, False, False], [2.2, 7.3, 6.9])
    """
    stack = jnp.where(jnp.isfinite(stack), stack, 0.0)
    _, height, width = stack.shape
    strength = lax.stop_gradient(jnp.where(_is_extremum(stack, test), jnp.abs(stack), 0.0))
    first = 0 if test.within_layer else 1
    inner = strength[first : stack.shape[0] - first].reshape(-1)
    count = min(capacity, inner.shape[0])
    strongest, index = lax.top_k(inner, count)
    index = jnp.where(strongest > 0, index, 0)
    start = jnp.stack([index // (height * width) + first, index // width % height, index % width], axis=1)
    found = _interpolate(stack, start.astype(jnp.int32), strongest > 0, test)
    pad = [(0, capacity - count)]
    return Extrema(jnp.pad(found.place, [*pad, (0, 0)]), jnp.pad(found.value, pad), jnp.pad(found.valid, pad))


def _is_extremum(stack: Float[Array, "s h w"], test: ExtremumTest) -> Bool[Array, "s h w"]:
    axes = (1, 2) if test.within_layer else (0, 1, 2)
    greatest = _neighborhood(stack, jnp.maximum, -jnp.inf, axes)
    extreme = (stack >= greatest) & (stack > 0.5 * test.least_value)
    if test.minima:
        least = _neighborhood(stack, jnp.minimum, jnp.inf, axes)
        extreme |= (stack <= least) & (stack < -0.5 * test.least_value)
    _, height, width = stack.shape
    margin = max(test.border, 1)
    row, column = jnp.arange(height), jnp.arange(width)
    rows, columns = (row >= margin) & (row < height - margin), (column >= margin) & (column < width - margin)
    return extreme & rows[None, :, None] & columns[None, None, :]


def _neighborhood(stack: Array, extremum: object, outside: float, axes: tuple[int, ...]) -> Array:
    """Maximum or minimum over three samples along each of the axes."""
    for axis in axes:
        edges = [(1, 1) if axis == k else (0, 0) for k in range(3)]
        padded, size = jnp.pad(stack, edges, constant_values=outside), stack.shape[axis]
        before, after = (lax.slice_in_dim(padded, start, start + size, axis=axis) for start in (0, 2))
        stack = extremum(stack, extremum(before, after))  # pyright: ignore[reportCallIssue]
    return stack


def _interpolate(stack: Array, start: Int[Array, "n 3"], valid: Bool[Array, " n"], test: ExtremumTest) -> Extrema:
    """Moves each extremum by whole samples until the vertex of its quadratic model is within half a sample."""
    limits = jnp.asarray(stack.shape, jnp.int32)
    margin = jnp.asarray([0 if test.within_layer else 1, max(test.border, 1), max(test.border, 1)], jnp.int32)
    frozen = lax.stop_gradient(stack)

    def move(_: object, state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        place, inside, settled = state
        offset = _vertex(_cubes(frozen, place), test.within_layer)[0]
        settled = settled | jnp.all(jnp.abs(offset) < 0.5, axis=1)
        step = jnp.clip(jnp.round(offset), -2.0, 2.0).astype(jnp.int32)
        moved = jnp.where(settled[:, None], place, place + step)
        fits = jnp.all((moved >= margin[None, :]) & (moved < (limits - margin)[None, :]), axis=1)
        return jnp.where(fits[:, None], moved, place), inside & fits, settled

    place, inside, settled = lax.fori_loop(0, _MOVES, move, (start, valid, jnp.zeros_like(valid)))
    cubes = _cubes(stack, place)
    offset, slope, (uu, vv, uv) = _vertex(cubes, test.within_layer)
    value = cubes[1][1][1] + 0.5 * jnp.sum(slope * offset, axis=1)
    trace, determinant = uu + vv, uu * vv - uv * uv
    ratio = test.edge_ratio
    isotropic = (determinant > 0) & (trace * trace * ratio < (ratio + 1.0) ** 2 * determinant)
    good = inside & settled & isotropic & (jnp.abs(value) >= test.least_value)
    place = jnp.where(good[:, None], place.astype(stack.dtype) + offset, 0.0)
    return Extrema(place, jnp.where(good, value, 0.0), good)


def _cubes(stack: Float[Array, "s h w"], place: Int[Array, "n 3"]) -> list[list[list[Array]]]:
    """The 3x3x3 neighborhoods of all places, as arrays over places."""
    _, height, width = stack.shape
    shifts = jnp.arange(-1, 2, dtype=place.dtype)
    around = (shifts[:, None, None] * height + shifts[None, :, None]) * width + shifts[None, None, :]
    flat = (place[:, 0] * height + place[:, 1]) * width + place[:, 2]
    # One gather for all: 27 of them take long to compile.
    samples = stack.reshape(-1)[around.reshape(-1)[:, None] + flat[None, :]]
    return [[[samples[9 * a + 3 * b + c] for c in range(3)] for b in range(3)] for a in range(3)]


def _vertex(cubes: list[list[list[Array]]], within_layer: bool) -> tuple[Array, Array, tuple[Array, Array, Array]]:
    """Offset of the quadratic model's vertex, gradient at the center, and second derivatives in the image."""
    middle = cubes[1][1][1]
    slope_s = 0.5 * (cubes[2][1][1] - cubes[0][1][1])
    slope_v = 0.5 * (cubes[1][2][1] - cubes[1][0][1])
    slope_u = 0.5 * (cubes[1][1][2] - cubes[1][1][0])
    ss = cubes[2][1][1] + cubes[0][1][1] - 2.0 * middle
    vv = cubes[1][2][1] + cubes[1][0][1] - 2.0 * middle
    uu = cubes[1][1][2] + cubes[1][1][0] - 2.0 * middle
    uv = 0.25 * (cubes[1][2][2] - cubes[1][2][0] - cubes[1][0][2] + cubes[1][0][0])
    us = 0.25 * (cubes[2][1][2] - cubes[2][1][0] - cubes[0][1][2] + cubes[0][1][0])
    vs = 0.25 * (cubes[2][2][1] - cubes[2][0][1] - cubes[0][2][1] + cubes[0][0][1])
    if within_layer:
        zero = jnp.zeros_like(middle)
        slope_s, ss, us, vs = zero, zero - 1.0, zero, zero
    # Cramer's rule for the symmetric matrix [[ss, vs, us], [vs, vv, uv], [us, uv, uu]].
    a, b, c = vv * uu - uv * uv, us * uv - vs * uu, vs * uv - us * vv
    determinant = ss * a + vs * b + us * c
    scale = jnp.abs(ss * a) + jnp.abs(vs * b) + jnp.abs(us * c)
    regular = jnp.abs(determinant) > 1e-6 * scale
    divisor = jnp.where(regular, determinant, 1.0)
    d, e, f = ss * uu - us * us, us * vs - ss * uv, ss * vv - vs * vs
    rows = (
        a * slope_s + b * slope_v + c * slope_u,
        b * slope_s + d * slope_v + e * slope_u,
        c * slope_s + e * slope_v + f * slope_u,
    )
    offset = jnp.stack([jnp.where(regular, -row / divisor, 1e3) for row in rows], axis=1)
    return offset, jnp.stack([slope_s, slope_v, slope_u], axis=1), (uu, vv, uv)
