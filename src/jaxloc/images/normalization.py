"""Photometric normalization: invariance of gray levels to exposure [K-22]."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Num

from jaxloc._jit import filter_jit
from jaxloc.images.gradients import convolve_columns, convolve_rows, pad_reflected


class GainBias(eqx.Module):
    """Photometric relation of two images, ``image = gain * reference + bias``.

    Attributes:
        gain: contrast, 1 where the reference is flat.
        bias: gray levels.
        ok: False where the reference is flat or nothing is valid.
    """

    gain: Float[Array, ""]
    bias: Float[Array, ""]
    ok: Bool[Array, ""]


def as_gray(image: Num[Array, "h w"] | Any, dtype: Any = None) -> Float[Array, "h w"]:
    """Converts gray levels to floating point; integers keep their values.

    Example:
        >>> import jax.numpy as jnp
        >>> as_gray(jnp.array([[200]], jnp.uint8)).tolist()
        [[200.0]]

    Raises:
        ValueError: no gray image, or one without pixels.
    """
    image = jnp.asarray(image)
    if image.ndim != 2:
        raise ValueError(f"A grayscale image has two axes (rows, columns); got an array of shape {image.shape}.")
    if not image.size:
        raise ValueError(f"An image has at least one pixel; got an array of shape {image.shape}.")
    if dtype is None:
        dtype = image.dtype if jnp.issubdtype(image.dtype, jnp.floating) else jnp.result_type(float)
    return image.astype(dtype)


@filter_jit
def standardize(image: Float[Array, "h w"], *, valid: Bool[Array, "h w"] | None = None) -> Float[Array, "h w"]:
    """Normalizes to zero mean and unit variance over the valid pixels: equal for ``I`` and ``a I + b``, a > 0.

    Args:
        image: grayscale image.
        valid: pixels that are used; others, and non-finite ones, become zero.

    Returns:
        ``(I - mean) / deviation``, zero for a flat image.

    Example:
        >>> import jax.numpy as jnp
        >>> standardize(jnp.array([[1.0, 3.0]])).tolist()
        [[-1.0, 1.0]]
    """
    valid, image = _usable(image, valid)
    centered, variance = _centered(image, valid)
    # Rounding errors of a flat image are no texture.
    level = jnp.max(jnp.abs(image))
    textured = variance > (4.0 * jnp.finfo(image.dtype).eps * level) ** 2
    return jnp.where(textured, centered / jnp.sqrt(jnp.where(textured, variance, 1.0)), 0.0)


@filter_jit
def standardize_locally(image: Float[Array, "h w"], *, radius: int = 8, floor: float = 1.0) -> Float[Array, "h w"]:
    """Local normalization to zero mean and unit variance over a square around every pixel.

    Args:
        image: grayscale image.
        radius: half the side of the square, px.
        floor: standard deviation of noise, gray levels, which limits the gain in flat regions.

    Returns:
        ``(I - mean) / sqrt(variance + floor^2)``.

    Example:
        >>> import jax.numpy as jnp
        >>> bool(jnp.all(jnp.abs(standardize_locally(jnp.ones((9, 9)), radius=2)) < 1e-6))
        True
    """
    weights = jnp.full(2 * radius + 1, 1.0 / (2 * radius + 1), image.dtype)

    def mean(values: Float[Array, "h w"]) -> Float[Array, "h w"]:
        return convolve_columns(convolve_rows(values, weights), weights)

    # Relative to the global mean, since squares of bright images are inaccurate.
    image = image - jnp.mean(image)
    local = mean(image)
    variance = jnp.maximum(mean(image * image) - local * local, 0.0)
    return (image - local) / jnp.sqrt(variance + floor**2)


@filter_jit
def fit_gain_bias(
    image: Float[Array, "h w"], reference: Float[Array, "h w"], *, valid: Bool[Array, "h w"] | None = None
) -> GainBias:
    """Least-squares gain and bias between two aligned images.

    Args:
        image: grayscale image.
        reference: image of the same scene.
        valid: pixels that are used.

    Returns:
        Gain and bias of ``image = gain * reference + bias``.

    Example:
        >>> import jax.numpy as jnp
        >>> reference = jnp.array([[0.0, 1.0, 2.0]])
        >>> fit = fit_gain_bias(0.5 * reference + 3.0, reference)
        >>> float(fit.gain), float(fit.bias)
        (0.5, 3.0)
    """
    valid, image = _usable(image, valid)
    valid, reference = _usable(reference, valid)
    image_centered, _ = _centered(jnp.where(valid, image, 0.0), valid)
    centered, variance = _centered(reference, valid)
    count = jnp.maximum(jnp.sum(valid), 1).astype(image.dtype)
    level = jnp.max(jnp.abs(reference))
    ok = variance > (4.0 * jnp.finfo(image.dtype).eps * level) ** 2
    gain = jnp.where(ok, jnp.sum(image_centered * centered) / (count * jnp.where(ok, variance, 1.0)), 1.0)
    total = jnp.sum(jnp.where(valid, image - gain * reference, 0.0))
    return GainBias(gain, total / count, ok)


@filter_jit
def rank_transform(image: Float[Array, "h w"], *, radius: int = 3) -> Float[Array, "h w"]:
    """Rank transform: fraction of darker neighbors in a square; invariant to increasing maps of gray levels.

    Args:
        image: grayscale image; borders are reflected.
        radius: half the side of the square, px.

    Returns:
        In [0, 1]. Piecewise constant in the image, so it has no gradient.

    References:
        Zabih and Woodfill, "Non-parametric local transforms for computing visual correspondence", 1994.

    Example:
        >>> import jax.numpy as jnp
        >>> image = jnp.arange(25.0).reshape(5, 5)
        >>> bool(jnp.all(rank_transform(image, radius=1) == rank_transform(jnp.sqrt(image), radius=1)))
        True
    """
    height, width = image.shape
    padded = pad_reflected(image, (radius, radius))
    side = 2 * radius + 1
    darker = jnp.zeros_like(image)
    for row in range(side):
        for column in range(side):
            darker = darker + (padded[row : row + height, column : column + width] < image).astype(image.dtype)
    return darker / (side * side - 1)


def _usable(image: Float[Array, "h w"], valid: Any) -> tuple[Bool[Array, "h w"], Float[Array, "h w"]]:
    finite = jnp.isfinite(image)
    valid = finite if valid is None else valid & finite
    return valid, jnp.where(valid, image, 0.0)


def _centered(image: Float[Array, "h w"], valid: Bool[Array, "h w"]) -> tuple[Float[Array, "h w"], Float[Array, ""]]:
    """The image less its mean, zero where not valid, and its variance."""
    count = jnp.maximum(jnp.sum(valid), 1).astype(image.dtype)
    centered = jnp.where(valid, image - jnp.sum(image) / count, 0.0)
    return centered, jnp.sum(centered * centered) / count
