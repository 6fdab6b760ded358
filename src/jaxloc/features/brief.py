"""BRIEF descriptors: binary comparisons of pairs of pixels, rotated with the keypoint, and selection of the pairs."""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxloc._jit import filter_jit
from jaxloc._linalg import matmul
from jaxloc.features.harris import Box
from jaxloc.features.keypoints import Descriptors, Keypoints

# Side of the patch, and of the squares whose means are compared, px.
SIDE, _MEAN = 31, 5


@filter_jit
def intensity_centroid(image: Float[Array, "h w"], uv: Float[Array, "n 2"], *, radius: int = 15) -> Float[Array, " n"]:
    """Orientation by the intensity centroid of a disc around a corner, ``atan2(m01, m10)``.

    Args:
        image: gray levels; continued by its border values.
        uv: corners; rounded to whole pixels.
        radius: of the disc, px; static.

    Returns:
        From the right axis towards down, rad in [0, 2 pi); zero where the moments are zero.

    References:
        Rosin, "Measuring corner properties", CVIU 1999; Rublee et al., ICCV 2011, section 3.2 (oFAST) [T-52].

    Example:
        >>> import jax.numpy as jnp
        >>> image = jnp.zeros((40, 40)).at[20:, :].set(50.0)
        >>> round(float(jnp.rad2deg(intensity_centroid(image, jnp.array([[20.0, 20.0]]))[0])), 3)
        90.0
    """
    height, width = image.shape
    widths = _half_widths(radius)
    disc = [(u, v) for v in range(-radius, radius + 1) for u in range(-widths[abs(v)], widths[abs(v)] + 1)]
    right, down = (jnp.asarray(np.array(side), jnp.int32) for side in zip(*disc, strict=True))
    place = jnp.round(lax.stop_gradient(jnp.where(jnp.isfinite(uv), uv, 0.0))).astype(jnp.int32)
    column = jnp.clip(place[:, :1] + right[None, :], 0, width - 1)
    row = jnp.clip(place[:, 1:] + down[None, :], 0, height - 1)
    image = jnp.where(jnp.isfinite(image), image, 0.0)
    values = image.reshape(-1)[row * width + column]
    across, along = (jnp.sum(values * side.astype(image.dtype)[None, :], axis=1) for side in (right, down))
    some = across * across + along * along > 0
    angle = jnp.arctan2(jnp.where(some, along, 0.0), jnp.where(some, across, 1.0))
    return angle % (2.0 * math.pi)


def _half_widths(radius: int) -> list[int]:
    """Half the width of each row of a disc, symmetric about its diagonals, rounded as in OpenCV."""
    diagonal = math.ceil(radius * math.sqrt(0.5))
    widths = [round(math.sqrt(radius * radius - v * v)) for v in range(math.floor(radius * math.sqrt(0.5) + 1) + 1)]
    widths += [0] * (radius + 1 - len(widths))
    start = 0
    for v in range(radius, diagonal - 1, -1):
        while widths[start] == widths[start + 1]:
            start += 1
        widths[v] = start
        start += 1
    return widths


@filter_jit
def draw_tests(key: Array, *, count: int = 256) -> Int[Array, "count 4"]:
    """Random pairs of pixels in a patch of 31 x 31, normal about the center with a fifth of the side as deviation.

    Args:
        key: of the random numbers.
        count: pairs; static.

    Returns:
        (right, down) of the first pixel and of the second, whole numbers within 13 of the center.

    References:
        Calonder, Lepetit, Strecha, Fua, "BRIEF", ECCV 2010, section 3.2, sampling II [T-53].

    Example:
        >>> import jax
        >>> draw_tests(jax.random.key(0)).shape
        (256, 4)
    """
    reach = SIDE // 2 - _MEAN // 2
    places = jnp.round(jax.random.normal(key, (count, 4), jnp.float32) * (SIDE / 5.0))
    return jnp.clip(places, -reach, reach).astype(jnp.int32)


@filter_jit
def compare(image: Float[Array, "h w"], keypoints: Keypoints, tests: Int[Array, "t 4"]) -> Bool[Array, "n t"]:
    """BRIEF tests: whether the first pixel of each pair is darker than the second, rotated with the keypoint.

    Compared are means of 5 x 5 pixels at the nearest pixel.

    Args:
        image: gray levels.
        keypoints: with `uv` and `angle`.
        tests: from `draw_tests` or `select_tests`.

    References:
        Rublee et al., "ORB: an efficient alternative to SIFT or SURF", ICCV 2011, section 4.1 (steered BRIEF) [T-53].

    Example:
        >>> import jax.numpy as jnp
        >>> ramp = jnp.broadcast_to(jnp.arange(40.0)[None, :], (40, 40))
        >>> points = Keypoints.from_uv(jnp.array([[20.0, 20.0]]))
        >>> compare(ramp, points, jnp.array([[-5, 0, 5, 0], [3, 0, -3, 0]], jnp.int32)).tolist()
        [[True, False]]
    """
    height, width = image.shape
    mean = Box(_MEAN).average(jnp.where(jnp.isfinite(image), image, 0.0)).reshape(-1)
    u, v = _places(keypoints, tests)
    index = jnp.clip(v, 0, height - 1) * width + jnp.clip(u, 0, width - 1)
    values = mean[index]
    return values[:, 0] < values[:, 1]


def _places(keypoints: Keypoints, tests: Int[Array, "t 4"]) -> tuple[Int[Array, "n 2 t"], Int[Array, "n 2 t"]]:
    """Columns and rows of the first and second pixels of all tests."""
    pairs = tests.astype(keypoints.uv.dtype).reshape(-1, 2, 2).transpose(1, 0, 2)[None]
    cos, sin = (f(keypoints.angle)[:, None, None] for f in (jnp.cos, jnp.sin))
    right, down = pairs[..., 0], pairs[..., 1]
    u = keypoints.uv[:, 0, None, None] + cos * right - sin * down
    v = keypoints.uv[:, 1, None, None] + sin * right + cos * down
    return jnp.round(u).astype(jnp.int32), jnp.round(v).astype(jnp.int32)


@filter_jit
def brief(image: Float[Array, "h w"], keypoints: Keypoints, tests: Int[Array, "t 4"]) -> Descriptors:
    """BRIEF descriptors: bits of all tests, packed as in OpenCV, the first in the lowest bit.

    Args:
        image: gray levels.
        keypoints: with `uv` and `angle`.
        tests: a multiple of eight.

    Returns:
        A byte for eight tests; not valid where a test leaves the image.

    Raises:
        ValueError: The number of tests is no multiple of eight.

    References:
        Calonder et al. 2010; Rublee et al. 2011 [T-53].

    Example:
        >>> import jax, jax.numpy as jnp
        >>> image = jax.random.uniform(jax.random.key(1), (60, 60), maxval=255.0)
        >>> points = Keypoints.from_uv(jnp.array([[30.0, 30.0], [2.0, 30.0]]))
        >>> found = brief(image, points, draw_tests(jax.random.key(0)))
        >>> found.values.shape, found.valid.tolist()
        ((2, 32), [True, False])
    """
    if tests.shape[0] % 8:
        raise ValueError(f"brief: {tests.shape[0]} tests do not fill bytes; give a multiple of eight, 256 as a rule.")
    height, width = image.shape
    bits = compare(image, keypoints, tests)
    u, v = _places(keypoints, tests)
    inside = jnp.all((u >= 0) & (v >= 0) & (u < width) & (v < height), axis=(1, 2))
    valid = keypoints.valid & inside
    values = jnp.packbits(bits, axis=1, bitorder="little")
    return Descriptors(jnp.where(valid[:, None], values, jnp.zeros((), jnp.uint8)), valid)


@filter_jit
def select_tests(bits: Bool[Array, "m k"], *, count: int = 256, limit: float = 0.2) -> Int[Array, " count"]:
    """Selects tests of low correlation and means near a half, as rBRIEF was learned.

    Candidates are taken from the one whose mean is nearest to a half; one is kept when its absolute correlation with
    all that were kept is below the limit. The limit grows until enough are found.

    Args:
        bits: results of k candidates on m training patches, of `compare`.
        count: tests to choose, at most k; static.
        limit: first limit of the correlation.

    Returns:
        Indices of the chosen candidates, in the order in which they were chosen.

    Raises:
        ValueError: More tests are wanted than there are candidates.

    References:
        Rublee et al. 2011, section 4.3 [T-53].

    Example:
        >>> import jax.numpy as jnp
        >>> select_tests(jnp.array([[0, 0, 1], [1, 1, 1], [0, 0, 0], [1, 1, 0]], bool), count=2).tolist()
        [0, 2]
    """
    total = bits.shape[1]
    if count > total:
        raise ValueError(f"select_tests: {count} tests of {total} candidates; give more candidates.")
    mean = jnp.mean(bits.astype(jnp.float32), axis=0)
    order = jnp.argsort(jnp.abs(mean - 0.5))
    centered = bits.astype(jnp.float32) - mean[None, :]
    length = jnp.sqrt(jnp.sum(centered * centered, axis=0))
    # A constant test has no information: it counts as correlated with all.
    some = length > 0
    centered = centered / jnp.where(some, length, 1.0)[None, :]
    correlation = jnp.abs(matmul(centered.T, centered))
    correlation = jnp.where(some[:, None] & some[None, :], correlation, 1.0)[order][:, order]

    def choose(most: Array) -> Bool[Array, " k"]:
        def visit(kept: Array, candidate: Array) -> tuple[Array, None]:
            free = jnp.max(jnp.where(kept, correlation[candidate], 0.0)) < most
            return kept.at[candidate].set(free), None

        return lax.scan(visit, jnp.zeros(total, bool), jnp.arange(total, dtype=jnp.int32))[0]

    def raised(state: tuple[Array, Array]) -> tuple[Array, Array]:
        most = 1.1 * state[0]
        return most, choose(most)

    first = jnp.asarray(limit, jnp.float32)
    found = lax.while_loop(lambda s: (jnp.sum(s[1]) < count) & (s[0] <= 1.0), raised, (first, choose(first)))[1]
    # Correlated ones fill the remaining slots.
    return order[jnp.argsort(~found, stable=True)[:count]].astype(jnp.int32)
