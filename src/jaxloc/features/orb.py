"""ORB features: FAST corners of an image pyramid, oriented by intensity centroids, with steered BRIEF, in JAX."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxloc._jit import filter_jit
from jaxloc.features.brief import SIDE, brief, draw_tests, intensity_centroid
from jaxloc.features.fast import segment_score, strongest_keypoints, suppress_non_maxima
from jaxloc.features.keypoints import Descriptors, Keypoints

# Corners by FAST's score for each one that is kept by Harris's.
_SURPLUS = 2


class Orb(eqx.Module):
    """Options of ORB.

    Attributes:
        levels: greatest number of pyramid levels; fewer in small images.
        factor: ratio of neighboring levels.
        threshold: least contrast of a corner, gray levels.
        harris_k: weight of the trace in Harris's response, by which corners are ranked.

    References:
        Rublee, Rabaud, Konolige, Bradski, "ORB: an efficient alternative to SIFT or SURF", ICCV 2011.
    """

    levels: int = eqx.field(static=True, default=8)
    factor: float = eqx.field(static=True, default=1.2)
    threshold: float = eqx.field(static=True, default=20.0)
    harris_k: float = eqx.field(static=True, default=0.04)

    def shapes(self, shape: tuple[int, ...]) -> list[tuple[int, int]]:
        """Rows and columns of the levels: the first, and all that are larger than two patches."""
        sizes = [tuple(max(round(n / self.factor**level), 1) for n in shape) for level in range(self.levels)]
        return sizes[:1] + [size for size in sizes[1:] if min(size) > 2 * SIDE]


@filter_jit
def orb(
    image: Float[Array, "h w"],
    *,
    options: Orb = Orb(),
    tests: Int[Array, "t 4"] | None = None,
    capacity: int = 1000,
) -> tuple[Keypoints, Descriptors]:
    """ORB keypoints of all pyramid levels and their binary descriptors.

    Args:
        image: gray levels 0-255.
        options: pyramid and thresholds.
        tests: pairs of BRIEF; drawn with a fixed key by default, so that descriptors of two calls are comparable.
        capacity: number of keypoints; divided among levels in proportion to their width.

    Returns:
        Keypoints, level by level (``octave``), ``response`` being Harris's, and 256 packed bits each.

    References:
        Rublee et al. 2011 [T-51...T-53].

    Example:
        >>> import jax, jax.numpy as jnp
        >>> image = jax.random.uniform(jax.random.key(1), (25, 30), maxval=255.0).repeat(4, 0).repeat(4, 1)
        >>> keypoints, descriptors = orb(image, options=Orb(levels=2), capacity=20)
        >>> bool(keypoints.valid.sum() > 5), descriptors.values.shape
        (True, (20, 32))
    """
    tests = draw_tests(jax.random.key(0)) if tests is None else tests
    image = jnp.where(jnp.isfinite(image), image, 0.0)
    shapes = options.shapes(image.shape)
    shares = [options.factor**-level for level in range(len(shapes))]
    ends = [round(capacity * sum(shares[: k + 1]) / sum(shares)) for k in range(len(shapes))]
    parts = []
    for level, (shape, start, end) in enumerate(zip(shapes, [0, *ends[:-1]], ends, strict=True)):
        smaller = image if level == 0 else jax.image.resize(image, shape, "linear")
        parts.append(_detect_level(smaller, options, tests, level, image.shape, end - start))
    keypoints, descriptors = jax.tree.map(lambda *x: jnp.concatenate(x), *parts)
    return keypoints, descriptors


def _rank_by_harris(image: Array, corners: Keypoints, options: Orb, capacity: int) -> Keypoints:
    """The corners with the greatest Harris responses, in a window of 7 x 7."""
    side, width = jnp.arange(-4, 5, dtype=jnp.int32), image.shape[1]
    at = corners.uv.astype(jnp.int32)
    row = jnp.clip(at[:, 1, None] + side[None, :], 0, image.shape[0] - 1)
    column = jnp.clip(at[:, 0, None] + side[None, :], 0, width - 1)
    patch = image.reshape(-1)[row[:, :, None] * width + column[:, None, :]]
    across = patch[:, :, 2:] - patch[:, :, :-2]
    along = patch[:, 2:] - patch[:, :-2]
    right = 0.125 * (across[:, 2:] + 2.0 * across[:, 1:-1] + across[:, :-2])
    down = 0.125 * (along[:, :, 2:] + 2.0 * along[:, :, 1:-1] + along[:, :, :-2])
    uu, uv, vv = (jnp.mean(x, axis=(1, 2)) for x in (right * right, right * down, down * down))
    response = uu * vv - uv * uv - options.harris_k * (uu + vv) ** 2
    _, best = lax.top_k(lax.stop_gradient(jnp.where(corners.valid, response, -jnp.inf)), capacity)
    ranked = jax.tree.map(lambda x: x[best], corners)
    return eqx.tree_at(lambda k: k.response, ranked, jnp.where(ranked.valid, response[best], 0.0))


def _detect_level(
    image: Array, options: Orb, tests: Array, level: int, whole: tuple[int, ...], capacity: int
) -> tuple[Keypoints, Descriptors]:
    """Keypoints of a level, in pixels of the whole image."""
    margin = SIDE // 2 + 1
    score = segment_score(image)
    corner = suppress_non_maxima(jnp.where(score > options.threshold, score, 0.0))
    rows, columns = (jnp.arange(n) for n in image.shape)
    inside = ((rows >= margin) & (rows < image.shape[0] - margin))[:, None]
    inside = inside & ((columns >= margin) & (columns < image.shape[1] - margin))[None, :]
    found = _rank_by_harris(
        image, strongest_keypoints(jnp.where(inside, corner, 0.0), _SURPLUS * capacity), options, capacity
    )
    angle = jnp.where(found.valid, intensity_centroid(image, found.uv, radius=SIDE // 2), 0.0)
    found = eqx.tree_at(lambda k: k.angle, found, angle)
    description = brief(image, found, tests)
    ratio = jnp.asarray([whole[1] / image.shape[1], whole[0] / image.shape[0]], image.dtype)
    # Pixels are squares: the corner of the image stays where it is, not the center of its first pixel.
    uv = jnp.where(description.valid[:, None], (found.uv + 0.5) * ratio[None, :] - 0.5, 0.0)
    size = jnp.where(description.valid, jnp.asarray(SIDE * options.factor**level, image.dtype), 0.0)
    octave = jnp.where(description.valid, jnp.full_like(found.octave, level), 0)
    angle, response = (jnp.where(description.valid, x, 0.0) for x in (found.angle, found.response))
    return Keypoints(uv, size, angle, response, octave, found.layer, description.valid, "orb"), description
