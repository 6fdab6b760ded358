"""FAST corners: segment test, score and non-maximum suppression as in OpenCV, in JAX."""

import functools

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxloc._jit import filter_jit
from jaxloc.features.keypoints import Keypoints

# The circle of radius three, (right, down), clockwise from the top.
CIRCLE = (
    *((0, -3), (1, -3), (2, -2), (3, -1), (3, 0), (3, 1), (2, 2), (1, 3)),
    *((0, 3), (-1, 3), (-2, 2), (-3, 1), (-3, 0), (-3, -1), (-2, -2), (-1, -3)),
)
_RADIUS, _SIZE = 3, 7.0


@filter_jit
def segment_score(image: Float[Array, "h w"], *, arc: int = 9) -> Float[Array, "h w"]:
    """FAST score: the greatest threshold at which a pixel is a corner.

    A pixel is a corner at threshold t when `arc` neighboring pixels of the 16 on a circle of radius three are all
    brighter than it by more than t, or all darker. So the score is ``max over arcs of min over the arc`` of differences
    of one sign; it is differentiable almost everywhere.

    Args:
        image: gray levels.
        arc: number of contiguous pixels, 9 to 12 as a rule; static.

    Returns:
        Gray levels; zero where no arc is brighter or darker, and within three pixels of the border. For whole gray
        levels, OpenCV's score is one less: the last whole threshold passed.

    Raises:
        ValueError: The arc is not between 1 and 16.

    References:
        Rosten and Drummond, "Machine learning for high-speed corner detection", ECCV 2006; thesis figure 2.16 [T-51].

    Example:
        >>> import jax.numpy as jnp
        >>> square = jnp.zeros((16, 16)).at[6:, 6:].set(100.0)
        >>> score = segment_score(square)
        >>> float(score[6, 6]), float(score[6, 12])
        (100.0, 0.0)
    """
    if not 1 <= arc <= len(CIRCLE):
        raise ValueError(f"segment_score: an arc of {arc} pixels does not fit a circle of {len(CIRCLE)}; 9 is usual.")
    height, width = image.shape
    if min(height, width) <= 2 * _RADIUS:
        return jnp.zeros_like(image)
    image = jnp.where(jnp.isfinite(image), image, 0.0)
    inner = height - 2 * _RADIUS, width - 2 * _RADIUS
    starts = [(_RADIUS + down, _RADIUS + right) for right, down in CIRCLE]
    middle = lax.dynamic_slice(image, (_RADIUS, _RADIUS), inner)
    differences = [lax.slice(image, s, (s[0] + inner[0], s[1] + inner[1])) - middle for s in starts]
    brighter = functools.reduce(jnp.maximum, _least_of_arcs(differences, arc))
    darker = functools.reduce(jnp.maximum, _least_of_arcs([-x for x in differences], arc))
    return jnp.pad(jnp.maximum(jnp.maximum(brighter, darker), 0.0), _RADIUS)


def _least_of_arcs(values: list[Array], arc: int) -> list[Array]:
    """Least value of `arc` contiguous values from each position on, by doubling."""
    length, least = 1, values
    while 2 * length <= arc:
        least = [jnp.minimum(least[k], least[(k + length) % 16]) for k in range(16)]
        length *= 2
    # Two arcs that overlap cover the rest.
    rest = arc - length
    return [jnp.minimum(least[k], least[(k + rest) % 16]) for k in range(16)] if rest else least


@filter_jit
def suppress_non_maxima(score: Float[Array, "h w"]) -> Float[Array, "h w"]:
    """Non-maximum suppression: scores not above those of all eight neighbors become zero, equal neighbors too.

    Example:
        >>> import jax.numpy as jnp
        >>> suppress_non_maxima(jnp.array([[0.0, 2.0, 3.0, 0.0, 1.0]])).tolist()
        [[0.0, 0.0, 3.0, 0.0, 1.0]]
    """
    wide = jnp.pad(score, 1)
    height, width = score.shape
    around = [wide[a : a + height, b : b + width] for a in range(3) for b in range(3) if (a, b) != (1, 1)]
    return jnp.where(score > functools.reduce(jnp.maximum, around), score, 0.0)


def fast(
    image: Float[Array, "h w"],
    *,
    threshold: float | int | Float[Array, ""] = 10.0,
    arc: int = 9,
    capacity: int = 1000,
) -> Keypoints:
    """FAST corners: segment test and non-maximum suppression.

    Args:
        image: gray levels.
        threshold: least difference between a corner and its arc, gray levels.
        arc: number of contiguous pixels, 9 (FAST-9) to 12 (FAST-12); static.
        capacity: greatest number of keypoints, the highest scores first.

    Returns:
        Keypoints at whole pixels, without orientation; `response` is the score.

    References:
        Rosten and Drummond 2006 [T-51].

    Example:
        >>> import jax.numpy as jnp
        >>> image = jnp.zeros((24, 24)).at[8, 15].set(100.0)
        >>> found = fast(image, capacity=2)
        >>> found.uv.tolist(), found.response.tolist(), found.valid.tolist()
        ([[15.0, 8.0], [0.0, 0.0]], [100.0, 0.0], [True, False])
    """
    # As an array, so that new values do not compile anew.
    return _fast(image, jnp.asarray(threshold, image.dtype), arc, capacity)


@filter_jit
def _fast(image: Array, threshold: Array, arc: int, capacity: int) -> Keypoints:
    score = segment_score(image, arc=arc)
    return strongest_keypoints(suppress_non_maxima(jnp.where(score > threshold, score, 0.0)), capacity)


def strongest_keypoints(response: Float[Array, "h w"], capacity: int) -> Keypoints:
    """Keypoints at the highest positive responses.

    Example:
        >>> import jax.numpy as jnp
        >>> strongest_keypoints(jnp.zeros((4, 5)).at[2, 3].set(1.0), 2).uv.tolist()
        [[3.0, 2.0], [0.0, 0.0]]
    """
    flat, width = response.reshape(-1), response.shape[1]
    kept = min(capacity, flat.shape[0])
    _, index = lax.top_k(lax.stop_gradient(flat), kept)
    best = flat[index]
    valid = best > 0
    index = jnp.where(valid, index, 0)
    uv = jnp.stack([index % width, index // width], axis=1).astype(response.dtype)
    uv, best, valid = (jnp.pad(x, [(0, capacity - kept)] + [(0, 0)] * (x.ndim - 1)) for x in (uv, best, valid))
    size, none = jnp.where(valid, jnp.asarray(_SIZE, response.dtype), 0.0), jnp.zeros(capacity, jnp.int32)
    return Keypoints(uv, size, jnp.zeros_like(size), jnp.where(valid, best, 0.0), none, none, valid, "fast")
