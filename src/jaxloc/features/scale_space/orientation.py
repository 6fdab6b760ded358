"""Dominant gradient direction of a neighborhood, by a sliding window of angles."""

import math

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxloc._jit import filter_jit
from jaxloc._linalg import matmul

_BATCH = 64


class DominantDirection(eqx.Module):
    """Dominant directions of neighborhoods.

    Attributes:
        angle: from the right axis towards down, rad in [0, 2 pi); zero where there is none.
        ok: False where all gradients are zero.
    """

    angle: Float[Array, " n"]
    ok: Bool[Array, " n"]


@filter_jit
def dominant_direction(
    right: Float[Array, "n k"], down: Float[Array, "n k"], *, width: float = math.pi / 3.0
) -> DominantDirection:
    """Direction of the longest sum of gradients within a window of angles.

    The window is placed at the angle of every gradient in turn, so that the result is invariant to rotation.

    Args:
        right: weighted derivatives along rows of each neighborhood.
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

    def one(gradients: tuple[Array, Array]) -> tuple[Array, Array]:
        right, down = gradients
        frozen_right, frozen_down = lax.stop_gradient(right), lax.stop_gradient(down)
        angle = jnp.arctan2(frozen_down, frozen_right)
        ahead = (angle[None, :] - angle[:, None]) % (2.0 * math.pi)
        within = (ahead < width).astype(right.dtype)
        sums = matmul(within, jnp.stack([frozen_right, frozen_down], axis=1))
        members = within[jnp.argmax(jnp.sum(sums * sums, axis=1))]
        return jnp.sum(members * right), jnp.sum(members * down)

    total_right, total_down = lax.map(one, (right, down), batch_size=min(_BATCH, max(len(right), 1)))
    some = total_right**2 + total_down**2 > 0
    angle = jnp.arctan2(jnp.where(some, total_down, 0.0), jnp.where(some, total_right, 1.0))
    return DominantDirection(angle % (2.0 * math.pi), some)


def disc_offsets(radius: int) -> tuple[list[int], list[int]]:
    """Offsets (right, down) of the whole pixels within a radius: 109 for six.

    Example:
        >>> len(disc_offsets(6)[0])
        109
    """
    side = range(-radius, radius + 1)
    inside = [(u, v) for v in side for u in side if u * u + v * v < radius * radius]
    return [u for u, _ in inside], [v for _, v in inside]


def normalize_rows(values: Float[Array, "n d"]) -> Float[Array, "n d"]:
    """Rows normalized to length one; zero rows stay zero.

    Example:
        >>> import jax.numpy as jnp
        >>> normalize_rows(jnp.array([[0.0, 4.0], [0.0, 0.0]])).tolist()
        [[0.0, 1.0], [0.0, 0.0]]
    """
    squared = jnp.sum(values * values, axis=1, keepdims=True)
    some = squared > 0
    return values / jnp.sqrt(jnp.where(some, squared, 1.0))


def rotate_gradients(right: Array, down: Array, angle: Float[Array, " n"]) -> tuple[Array, Array]:
    """Derivatives "n k" along and across each keypoint's orientation.

    Example:
        >>> import jax.numpy as jnp
        >>> along, across = rotate_gradients(jnp.array([[0.0]]), jnp.array([[2.0]]), jnp.array([jnp.pi / 2]))
        >>> float(along[0, 0]), abs(round(float(across[0, 0]), 6))
        (2.0, 0.0)
    """
    cos, sin = jnp.cos(angle)[:, None], jnp.sin(angle)[:, None]
    return cos * right + sin * down, cos * down - sin * right
