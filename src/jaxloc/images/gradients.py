"""Image derivatives and Gaussian smoothing by separable kernels, with borders reflected as in OpenCV."""

import math

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxloc._jit import filter_jit


class ImageGradient(eqx.Module):
    """First derivatives of an image in gray levels a pixel.

    Attributes:
        right: Derivative along a row, dI/du.
        down: Derivative along a column, dI/dv.
    """

    right: Float[Array, "h w"]
    down: Float[Array, "h w"]


@filter_jit
def central_difference(image: Float[Array, "h w"]) -> ImageGradient:
    """Differentiates by `(I[x + 1] - I[x - 1]) / 2`.

    Args:
        image: Grayscale image.

    Returns:
        Both derivatives, in gray levels a pixel; zero across the reflected border.

    Example:
        >>> import jax.numpy as jnp
        >>> ramp = jnp.broadcast_to(3.0 * jnp.arange(5.0)[None, :], (4, 5))
        >>> float(central_difference(ramp).right[2, 2])
        3.0
    """
    return _derivative(image, (0.0, 1.0, 0.0))


@filter_jit
def sobel(image: Float[Array, "h w"]) -> ImageGradient:
    """Differentiates with Sobel's 3x3 kernel, scaled to gray levels a pixel: `cv2.Sobel(ksize=3) / 8`.

    Args:
        image: Grayscale image.

    Returns:
        Both derivatives.

    Example:
        >>> import jax.numpy as jnp
        >>> ramp = jnp.broadcast_to(3.0 * jnp.arange(5.0)[None, :], (4, 5))
        >>> float(sobel(ramp).right[2, 2])
        3.0
    """
    return _derivative(image, (0.25, 0.5, 0.25))


@filter_jit
def scharr(image: Float[Array, "h w"]) -> ImageGradient:
    """Differentiates with Scharr's 3x3 kernel, scaled to gray levels a pixel: `cv2.Scharr / 32`.

    Args:
        image: Grayscale image.

    Returns:
        Both derivatives; more isotropic than Sobel's.

    References:
        Scharr, "Optimal operators in digital image processing" (2000).

    Example:
        >>> import jax.numpy as jnp
        >>> ramp = jnp.broadcast_to(3.0 * jnp.arange(5.0)[:, None], (5, 4))
        >>> round(float(scharr(ramp).down[2, 2]), 4)
        3.0
    """
    return _derivative(image, (3.0 / 16.0, 10.0 / 16.0, 3.0 / 16.0))


@filter_jit
def smooth(
    image: Float[Array, "h w"], sigma: float | int | Float[Array, ""], *, radius: int | None = None
) -> Float[Array, "h w"]:
    """Smooths with a Gaussian, truncated at `radius` pixels and normalized: `cv2.GaussianBlur` of size `2 radius + 1`.

    Args:
        image: Grayscale image.
        sigma: Standard deviation in pixels. A Python number fixes it at trace time, an array can be differentiated.
        radius: Static radius of the kernel; three sigma by default, needed when `sigma` is an array.

    Returns:
        The smoothed image, borders reflected about the border pixel.

    Raises:
        ValueError: `sigma` is an array and no radius is given.

    Example:
        >>> import jax.numpy as jnp
        >>> spike = jnp.zeros((9, 9)).at[4, 4].set(1.0)
        >>> round(float(smooth(spike, 1.0).sum()), 4)
        1.0
    """
    if radius is None:
        if not isinstance(sigma, float | int):
            raise ValueError("smooth: an array sigma needs a static radius, for example radius=6.")
        # A border is reflected once: the radius is limited by the image.
        radius = max(1, min(math.ceil(3.0 * sigma), min(image.shape) - 1))
    offsets = jnp.arange(-radius, radius + 1, dtype=image.dtype)
    weights = jnp.exp(-0.5 * (offsets / jnp.asarray(sigma, image.dtype)) ** 2)
    weights = weights / weights.sum()
    return convolve_rows(convolve_columns(image, weights), weights)


def convolve_rows(image: Float[Array, "h w"], weights: Float[Array, " k"]) -> Float[Array, "h w"]:
    """Correlates every row with an odd kernel, borders reflected about the border pixel.

    Example:
        >>> import jax.numpy as jnp
        >>> convolve_rows(jnp.array([[1.0, 2.0, 4.0]]), jnp.array([0.0, 0.0, 1.0])).tolist()
        [[2.0, 4.0, 2.0]]
    """
    radius, width = weights.shape[0] // 2, image.shape[1]
    padded = pad_reflected(image, (0, radius))
    return sum(weights[k] * padded[:, k : k + width] for k in range(weights.shape[0]))


def convolve_columns(image: Float[Array, "h w"], weights: Float[Array, " k"]) -> Float[Array, "h w"]:
    """Correlates every column with an odd kernel, borders reflected about the border pixel.

    Example:
        >>> import jax.numpy as jnp
        >>> convolve_columns(jnp.array([[1.0], [2.0], [4.0]]), jnp.array([0.0, 0.0, 1.0])).tolist()
        [[2.0], [4.0], [2.0]]
    """
    radius, height = weights.shape[0] // 2, image.shape[0]
    padded = pad_reflected(image, (radius, 0))
    return sum(weights[k] * padded[k : k + height] for k in range(weights.shape[0]))


def pad_reflected(image: Float[Array, "h w"], margin: tuple[int, int]) -> Float[Array, "h2 w2"]:
    """Widens an image by `margin = (rows, columns)` on each side, reflected about the border pixel (`gfedcb|abcdefgh`).

    Example:
        >>> import jax.numpy as jnp
        >>> pad_reflected(jnp.array([[1.0, 2.0, 3.0]]), (0, 1)).tolist()
        [[2.0, 1.0, 2.0, 3.0, 2.0]]
    """
    return jnp.pad(image, ((margin[0], margin[0]), (margin[1], margin[1])), mode="reflect")


def _derivative(image: Float[Array, "h w"], across: tuple[float, float, float]) -> ImageGradient:
    """Central difference along one axis, a three-tap mean along the other."""
    height, width = image.shape
    padded = pad_reflected(image, (1, 1))
    rows = sum(weight * padded[k : k + height] for k, weight in enumerate(across) if weight)
    columns = sum(weight * padded[:, k : k + width] for k, weight in enumerate(across) if weight)
    return ImageGradient(0.5 * (rows[:, 2:] - rows[:, :-2]), 0.5 * (columns[2:] - columns[:-2]))
