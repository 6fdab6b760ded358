"""Suppression by square covering: as many points as wanted, the strongest first, none within a square of another."""

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxloc.images.select import Selection

# Halvings of the square's side.
_HALVINGS = 12


@eqx.filter_jit
def cover_squares(
    uv: Float[Array, "n 2"],
    score: Float[Array, " n"],
    valid: Bool[Array, " n"],
    *,
    shape: tuple[int, int],
    capacity: int,
) -> Selection:
    """Chooses points that keep a distance, the greatest one that still fills the slots.

    Points are taken from the strongest on; each forbids the square around it. The side of the square is found by
    halving, so that at least `capacity` points are left, and the strongest of those are kept.

    Args:
        uv: Pixel coordinates (right, down).
        score: The greater, the better.
        valid: Which points exist.
        shape: Static image size (rows, columns), px.
        capacity: Static number of slots of the result.

    Returns:
        Indices, strongest first; all valid points where there are fewer than slots.

    References:
        Bailo, Rameau, Joo, Park, Bogdan, Kweon, "Efficient adaptive non-maximal suppression algorithms for homogeneous
        spatial keypoint distribution", Pattern Recognition Letters 2018 (SSC), which halves as well.

    Example:
        >>> import jax.numpy as jnp
        >>> uv = jnp.array([[1.0, 1.0], [2.0, 1.0], [9.0, 9.0]])
        >>> cover_squares(uv, jnp.array([3.0, 2.0, 1.0]), jnp.ones(3, bool), shape=(10, 10), capacity=2).index.tolist()
        [0, 2]
    """
    n = uv.shape[0]
    order = jnp.lexsort((-score, ~valid)).astype(jnp.int32)
    places = jnp.where(valid[:, None], lax.stop_gradient(uv), 0.0)[order]
    alive = valid[order]

    def halve(_: Array, state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        low, high, best = state
        side = 0.5 * (low + high)
        kept = _kept(places, alive, side)
        enough = jnp.sum(kept) >= min(capacity, n)
        return jnp.where(enough, side, low), jnp.where(enough, high, side), jnp.where(enough, kept, best)

    far = jnp.asarray(float(max(shape)), uv.dtype)
    _, _, best = lax.fori_loop(0, _HALVINGS, halve, (jnp.zeros_like(far), far, alive))
    rank = jnp.argsort(~best, stable=True)[:capacity]
    chosen = jnp.pad(best[rank], (0, max(capacity - n, 0)))
    index = jnp.pad(order[rank], (0, max(capacity - n, 0)))
    return Selection(jnp.where(chosen, index, 0), chosen)


def _kept(places: Float[Array, "n 2"], alive: Bool[Array, " n"], side: Float[Array, ""]) -> Bool[Array, " n"]:
    """Points that remain when each that is kept forbids weaker ones less than half a side away along both axes."""

    def visit(free: Array, k: Array) -> tuple[Array, Array]:
        keep = free[k]
        near = jnp.max(jnp.abs(places - places[k][None, :]), axis=1) < 0.5 * side
        return free & ~(keep & near), keep

    return lax.scan(visit, alive, jnp.arange(places.shape[0], dtype=jnp.int32))[1]
