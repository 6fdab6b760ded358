"""KLT tracking between two images, between prepared frames, and through a video."""

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, UInt8

from jaxloc._jit import filter_jit
from jaxloc.alignment.klt.covariance import conclude
from jaxloc.alignment.klt.frames import Frame, build_frame, relative_gain
from jaxloc.alignment.klt.records import Klt, Tracked
from jaxloc.alignment.klt.search import search
from jaxloc.images.interpolation import inside_image


@filter_jit
def prepare(image: Float[Array, "h w"] | UInt8[Array, "h w"], *, options: Klt = Klt()) -> Frame:  # noqa: B008
    """Preprocesses an image for tracking, so that each frame of a video is prepared once.

    Args:
        image: Grayscale image of any dtype; integers become float32.
        options: Patch size and levels. Small images get fewer levels.

    Returns:
        The frame for `track_frames`.

    Raises:
        ValueError: The image is smaller than a patch.

    Example:
        >>> import jax.numpy as jnp
        >>> prepare(jnp.zeros((100, 120), jnp.uint8)).levels
        4
    """
    if min(image.shape) < options.size:
        raise ValueError(f"prepare: a patch of {options.size} px does not fit an image of shape {image.shape}.")
    levels = options.levels
    while levels > 1 and min(image.shape) >> (levels - 1) < max(options.size // 2, 4):
        levels -= 1
    return build_frame(image, levels, options.size // 2 + 2)


@filter_jit
def track(
    previous: Float[Array, "h w"] | UInt8[Array, "h w"],
    current: Float[Array, "h2 w2"] | UInt8[Array, "h2 w2"],
    points: Float[Array, "n 2"],
    *,
    initial: Float[Array, "n 2"] | None = None,
    valid: Bool[Array, " n"] | None = None,
    options: Klt = Klt(),  # noqa: B008 (an immutable record)
) -> Tracked:
    """Tracks points from one image to the next.

    Minimizes `sum (I(x + d) - g T(x) - b)^2` over d, gain g and bias b of every patch T of the previous image, from the
    coarsest level of a pyramid to the finest, with the template's derivatives (inverse composition). The gain is near
    that of the whole image, which is estimated from the distributions of gray levels: a free gain would reduce the
    basin of convergence. Gradients with respect to both images and the points are those of the solution (implicit
    function theorem).

    Args:
        previous: Grayscale image; integers become float32.
        current: Image of the same shape.
        points: Pixels (right, down) of the previous image.
        initial: Positions in the current image; by default those in the previous one.
        valid: Points to be tracked; others are not `ok`.
        options: Patches, pyramid and thresholds.

    Returns:
        Pixels in the current image with residual, covariance and gain. The covariance is `s^2 / g^2 H^-1` with
        s^2 the residual's variance and H the structure matrix with gain and bias projected out.

    Raises:
        ValueError: The images differ in shape, or are smaller than a patch.

    References:
        Lucas-Kanade tracking [K-27]; Baker and Matthews, "Lucas-Kanade 20 years on" (2004), sections 3.2 and 4;
        Bouguet, "Pyramidal implementation of the Lucas Kanade feature tracker" (2000).

    Example:
        >>> import jax.numpy as jnp
        >>> u, v = jnp.meshgrid(jnp.arange(90.0), jnp.arange(80.0))
        >>> scene = lambda du, dv: 100 + 50 * jnp.sin(0.3 * (u - du)) * jnp.cos(0.2 * (v - dv))
        >>> found = track(scene(0.0, 0.0), 0.7 * scene(3.2, -1.4) + 20, jnp.array([[40.0, 40.0]]))
        >>> [round(x, 1) for x in found.points[0].tolist()], bool(found.ok[0]), round(float(found.gain[0]), 1)
        ([43.2, 38.6], True, 0.7)
    """
    frames = prepare(previous, options=options), prepare(current, options=options)
    return track_frames(*frames, points, initial=initial, valid=valid, options=options)


@filter_jit
def track_frames(
    previous: Frame,
    current: Frame,
    points: Float[Array, "n 2"],
    *,
    initial: Float[Array, "n 2"] | None = None,
    valid: Bool[Array, " n"] | None = None,
    options: Klt = Klt(),  # noqa: B008 (an immutable record)
) -> Tracked:
    """Tracks points between frames of `prepare`; see `track`.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> frame = prepare(100 * jax.random.uniform(jax.random.key(0), (60, 60)))
        >>> found = track_frames(frame, frame, jnp.array([[30.0, 30.0]]))
        >>> bool(jnp.allclose(found.points, 30.0, atol=1e-3))
        True
    """
    if previous.shape != current.shape:
        raise ValueError(f"track: images must have the same shape, not {previous.shape} and {current.shape}.")
    if min(previous.margin, current.margin) < options.size // 2 + 2 or previous.levels != current.levels:
        raise ValueError("track_frames: prepare both frames with the same options.")
    valid = jnp.ones(points.shape[:1], dtype=bool) if valid is None else valid
    first = points if initial is None else initial
    middle = 0.5 * jnp.array([previous.shape[1] - 1, previous.shape[0] - 1], dtype=points.dtype)[None, :]
    first = lax.stop_gradient(jnp.where(jnp.all(jnp.isfinite(first), axis=1)[:, None], first, middle))
    usable = valid & inside_image(points, previous.shape)
    source = jnp.where(usable[:, None], points, middle)
    gains = relative_gain(previous, current) * jnp.array([1.0 / options.gain_freedom, options.gain_freedom])
    near = search(previous, current, source, jnp.where(usable[:, None], first - source, 0.0), gains, options)
    found = conclude(previous, current, source, near, usable, gains, options)
    if options.max_forward_backward is not None:
        found = _check_backward(previous, current, source, found, gains, options)
    uv = jnp.where(found.ok[:, None], found.points, first)
    return eqx.tree_at(lambda tracked: tracked.points, found, uv)


def _check_backward(previous: Frame, current: Frame, source, found: Tracked, gains, options: Klt) -> Tracked:
    """Forward-backward test: tracks the found points back and rejects those with a large error."""
    uv = lax.stop_gradient(jnp.where(found.ok[:, None], found.points, source))
    back = search(current, previous, uv, jnp.zeros_like(uv), 1.0 / gains[::-1], options)
    error = back.cell.astype(uv.dtype) + back.fraction.astype(uv.dtype) + options.size // 2 - source
    missed = jnp.where(found.ok, jnp.linalg.norm(lax.stop_gradient(error), axis=1), 0.0).astype(found.residual.dtype)
    ok = found.ok & (missed <= options.max_forward_backward)
    return eqx.tree_at(lambda tracked: (tracked.ok, tracked.forward_backward), found, (ok, missed))


@filter_jit
def track_sequence(
    images: Float[Array, "t h w"] | UInt8[Array, "t h w"],
    points: Float[Array, "n 2"],
    *,
    options: Klt = Klt(),  # noqa: B008 (an immutable record)
) -> Tracked:
    """Tracks points of the first image through a video, from frame to frame.

    Args:
        images: The video.
        points: Pixels of its first image.
        options: Patches, pyramid and thresholds.

    Returns:
        Results for every image but the first; lost points are not tracked again.

    Raises:
        ValueError: a video without images.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> image = 100 * jax.random.uniform(jax.random.key(0), (60, 60))
        >>> followed = track_sequence(jnp.stack([image, image, image]), jnp.array([[30.0, 30.0]]))
        >>> followed.points.shape, bool(followed.ok.all())
        ((2, 1, 2), True)
    """
    if not images.shape[0]:
        raise ValueError("track_sequence: a video without images; the points are those of its first one.")

    def advance(state, image):
        frame, uv, ok = state
        following = prepare(image, options=options)
        found = track_frames(frame, following, uv, valid=ok, options=options)
        return (following, found.points, found.ok), found

    first = prepare(images[0], options=options), points, jnp.ones(points.shape[0], dtype=bool)
    return lax.scan(advance, first, images[1:])[1]
