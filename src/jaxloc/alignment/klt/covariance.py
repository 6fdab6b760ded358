"""Last step of tracking: a Newton step that has the derivatives of the solution, covariance and validity."""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxloc.alignment.klt.frames import Frame
from jaxloc.alignment.klt.patch_sums import (
    PatchSums,
    at_fraction,
    cut_window,
    determinant_of,
    regress,
    shift,
    split_pixel,
    sum_patches,
)
from jaxloc.alignment.klt.records import Klt, Tracked
from jaxloc.alignment.klt.search import Found
from jaxloc.images.interpolation import inside_image
from jaxloc.images.patches import slice_windows


def conclude(
    previous: Frame,
    current: Frame,
    points: Float[Array, "n 2"],
    found: Found,
    usable: Bool[Array, " n"],
    gains: Float[Array, " 2"],
    options: Klt,
) -> Tracked:
    """Covariance and validity of found positions, in chunks whose patches fit the cache.

    Args:
        previous: First frame.
        current: Second frame.
        points: Pixels of the first frame; finite.
        found: Result of `search` in the second frame.
        usable: Points that can be ok.
        gains: Least and greatest gain.
        options: Patches and thresholds.

    Returns:
        The tracked points, with derivatives.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> from jaxloc.alignment.klt.frames import build_frame
        >>> from jaxloc.alignment.klt.search import search
        >>> frame = build_frame(100 * jax.random.uniform(jax.random.key(0), (60, 60)), 1, 12)
        >>> at, gains = jnp.array([[30.0, 30.0]]), jnp.array([0.8, 1.2])
        >>> found = search(frame, frame, at, jnp.zeros((1, 2)), gains, Klt())
        >>> bool(conclude(frame, frame, at, found, jnp.array([True]), gains, Klt()).ok[0])
        True
    """
    count = points.shape[0]
    width = max(1, min(options.chunk, count))
    chunks = -(-count // width)

    def divide(x):
        return jnp.pad(x, [(0, chunks * width - count)] + [(0, 0)] * (x.ndim - 1)).reshape(chunks, width, *x.shape[1:])

    divided = jax.tree.map(divide, (points, found, usable))
    results = lax.map(lambda each: _conclude_some(previous, current, *each, gains, options), divided)
    return jax.tree.map(lambda x: x.reshape(chunks * width, *x.shape[2:])[:count], results)


@jax.custom_jvp
def _keep_sums(source, below, window, sums: PatchSums) -> PatchSums:
    """The sums of the search, with derivatives by summing the patches again, which costs only where they are used."""
    return sums


@_keep_sums.defjvp
def _differentiate_sums(primals, tangents):
    return primals[3], jax.jvp(sum_patches, primals[:3], tangents[:3])[1]


def _conclude_some(previous: Frame, current: Frame, points, found: Found, usable, gains, options: Klt) -> Tracked:
    half, dtype, pixels = options.size // 2, previous.atlas.dtype, options.size**2
    at, below = split_pixel(points - (half + 1))
    usable = usable & _finite(previous, at, options.size + 3) & _finite(current, found.cell, options.size + 1)
    source = cut_window(previous.atlas, at + previous.margin, options.size + 2)
    window = cut_window(current.atlas, found.cell + current.margin, options.size)
    kept = PatchSums(found.gram.T.reshape(3, 3, -1), found.cross.T.reshape(2, 2, 3, -1))
    sums = _keep_sums(source, below.T.astype(dtype), window, kept)
    fraction, converged = _newton(sums, found.fraction.T, gains)
    step, gain = regress(sums, fraction, gains)
    converged = converged & (jnp.max(jnp.abs(step), axis=0) < 0.05)
    converged = converged & (jnp.max(jnp.abs(fraction - 0.5), axis=0) < 0.6)
    patch = shift(window, fraction)
    energy = jnp.maximum(jnp.sum(patch * patch, axis=(0, 1)) - jnp.sum(patch, axis=(0, 1)) ** 2 / pixels, 0.0)
    contrast, product = sums.gram[2, 2], at_fraction(sums, fraction)[2]
    squares = jnp.maximum(energy - 2.0 * gain * product + gain * gain * contrast, 0.0)
    uv = found.cell.astype(points.dtype) + half + fraction.T.astype(points.dtype)
    scale = energy * contrast
    some = scale > 0
    correlation = jnp.where(some, product / jnp.sqrt(jnp.where(some, scale, 1.0)), 0.0)
    ok = usable & converged & determinant_of(sums)[1] & inside_image(uv, current.shape)
    ok = ok & (correlation >= options.min_correlation)
    through = gain * gain * _kept_noise(below).astype(dtype) + _kept_noise(fraction.T)
    # Interpolated noise is smaller but correlated; its effect along the (smooth) slopes is that of uncorrelated noise.
    noise = squares / (pixels - 4) * (1.0 + gain * gain) / jnp.maximum(through, 0.05)
    covariance = _covariance(sums, noise / (gain * gain), ok, options)
    # The root of a perfect match's zero has no gradient; zero is used there.
    positive = ok & (squares > 0)
    residual = jnp.where(positive, jnp.sqrt(jnp.where(positive, squares / pixels, 1.0)), 0.0)
    gain, correlation = jnp.where(ok, gain, 1.0), jnp.where(ok, correlation, 0.0)
    return Tracked(uv, ok, residual, covariance, gain, correlation, jnp.zeros_like(residual))


def _newton(sums: PatchSums, fraction, gains):
    """Newton steps on the Gauss-Newton step, which is zero at the solution; the last has the solution's derivatives."""
    frozen, fraction = lax.stop_gradient((sums, fraction))
    fraction, _ = _newton_step(frozen, frozen, fraction, gains)
    return _newton_step(sums, frozen, fraction, gains)


def _newton_step(sums: PatchSums, frozen: PatchSums, fraction, gains):
    """One step with the slope of the frozen sums, and whether it is short and the slope near the identity."""

    def slope(row):
        tangent = jnp.zeros_like(fraction).at[row].set(1.0)
        return jax.jvp(lambda at: regress(frozen, at, gains)[0], (fraction,), (tangent,))[1]

    (a, b), (c, d) = slope(0), slope(1)
    step = regress(sums, fraction, gains)[0]
    determinant = a * d - b * c
    near = (a + d > 0.6) & (determinant > 0.1)
    solved = jnp.stack([d * step[0] - c * step[1], a * step[1] - b * step[0]]) / jnp.where(near, determinant, 1.0)[None]
    moved = jnp.where(near[None], solved, step)
    small = jnp.max(jnp.abs(moved), axis=0) < 0.3
    return fraction - jnp.where(small[None], moved, 0.0), near & small


def _kept_noise(fraction):
    """Variance of bilinearly interpolated noise over that of the pixels: the sum of squared weights."""
    return jnp.prod((1.0 - fraction) ** 2 + fraction**2, axis=1)


def _finite(frame: Frame, corner, size: int):
    """Whether all pixels of each window are finite; nearly always all of the image are."""

    def check(_):
        unknown = jnp.where(frame.finite, 0.0, 1.0).astype(frame.atlas.dtype)
        return jnp.max(slice_windows(unknown, corner + frame.margin, (size, size)), axis=(1, 2)) < 0.5

    return lax.cond(frame.all_finite, lambda _: jnp.ones(corner.shape[0], dtype=bool), check, None)


def _covariance(sums: PatchSums, variance, ok, options: Klt):
    """Inverse structure matrix with gain and bias projected out, times the noise, with a floor; 1 px^2 where not ok."""
    (a, b, p), (_, c, q), (_, _, e) = sums.gram
    energy = jnp.where(e > 0, e, 1.0)
    a, b, c = a - p * p / energy, b - p * q / energy, c - q * q / energy
    determinant = a * c - b * b
    regular = ok & (determinant > 1e-6 * (a + c) ** 2) & (determinant > 0)
    scale = jnp.where(regular, variance, 0.0) / jnp.where(regular, determinant, 1.0)
    floor = jnp.where(regular, options.least_sigma**2, 1.0)
    rows = jnp.stack([c * scale + floor, -b * scale]), jnp.stack([-b * scale, a * scale + floor])
    return jnp.transpose(jnp.stack(rows), (2, 0, 1))
