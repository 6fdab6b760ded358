"""The direction of a neighborhood: where most of its slopes point, within a window that slides around the circle."""

import math

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxloc._linalg import matmul

_TOGETHER = 64


class DominantDirection(eqx.Module):
    """Directions of neighborhoods.

    Attributes:
        angle: from the right axis towards down, rad in [0, 2 pi); zero where there is none.
        ok: False where all slopes are zero.
    """

    angle: Float[Array, " n"]
    ok: Bool[Array, " n"]


@eqx.filter_jit
def dominant_direction(
    right: Float[Array, "n k"], down: Float[Array, "n k"], *, width: float = math.pi / 3.0
) -> DominantDirection:
    """Direction of the longest sum of slopes within a window of directions.

    Every slope begins a window in turn: no other window holds more, and nothing depends on where angles begin.

    Args:
        right: weighted slopes along rows of each neighborhood.
        down: along columns.
        width: of the window, rad; static.

    References:
        Bay et al., CVIU 2008, section 4.1 (sliding window of 60 degrees) [T-38]; KAZE has the same.

    Example:
        >>> import jax.numpy as jnp
        >>> right, down = jnp.array([[1.0, 1.0, -1.5]]), jnp.array([[0.9, 1.1, 0.0]])
        >>> round(float(jnp.rad2deg(dominant_direction(right, down).angle[0])), 3)
        45.0
    """

    def one(slopes: tuple[Array, Array]) -> tuple[Array, Array]:
        right, down = slopes
        frozen_right, frozen_down = lax.stop_gradient(right), lax.stop_gradient(down)
        angle = jnp.arctan2(frozen_down, frozen_right)
        ahead = (angle[None, :] - angle[:, None]) % (2.0 * math.pi)
        within = (ahead < width).astype(right.dtype)
        sums = matmul(within, jnp.stack([frozen_right, frozen_down], axis=1))
        members = within[jnp.argmax(jnp.sum(sums * sums, axis=1))]
        return jnp.sum(members * right), jnp.sum(members * down)

    total_right, total_down = lax.map(one, (right, down), batch_size=min(_TOGETHER, max(len(right), 1)))
    some = total_right**2 + total_down**2 > 0
    angle = jnp.arctan2(jnp.where(some, total_down, 0.0), jnp.where(some, total_right, 1.0))
    return DominantDirection(angle % (2.0 * math.pi), some)


def disc(radius: int) -> tuple[list[int], list[int]]:
    """Whole samples (right, down) within a radius: 109 for six.

    Example:
        >>> len(disc(6)[0])
        109
    """
    side = range(-radius, radius + 1)
    inside = [(u, v) for v in side for u in side if u * u + v * v < radius * radius]
    return [u for u, _ in inside], [v for _, v in inside]


def unit_rows(values: Float[Array, "n d"]) -> Float[Array, "n d"]:
    """Rows of length one, zero where they are zero.

    Example:
        >>> import jax.numpy as jnp
        >>> unit_rows(jnp.array([[0.0, 4.0], [0.0, 0.0]])).tolist()
        [[0.0, 1.0], [0.0, 0.0]]
    """
    squared = jnp.sum(values * values, axis=1, keepdims=True)
    some = squared > 0
    return values / jnp.sqrt(jnp.where(some, squared, 1.0))


def turned(right: Array, down: Array, angle: Float[Array, " n"]) -> tuple[Array, Array]:
    """Slopes "n k" along and across each keypoint's direction.

    Example:
        >>> import jax.numpy as jnp
        >>> along, across = turned(jnp.array([[0.0]]), jnp.array([[2.0]]), jnp.array([jnp.pi / 2]))
        >>> float(along[0, 0]), abs(round(float(across[0, 0]), 6))
        (2.0, 0.0)
    """
    cos, sin = jnp.cos(angle)[:, None], jnp.sin(angle)[:, None]
    return cos * right + sin * down, cos * down - sin * right
