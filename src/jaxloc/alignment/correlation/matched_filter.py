"""Matched filter: the linear filter of the greatest signal-to-noise ratio for a known pattern [K-25]."""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax.scipy.special import ndtri
from jaxtyping import Array, Float, Num

from jaxloc._jit import filter_jit
from jaxloc.images.normalization import as_gray


class Response(eqx.Module):
    """Response of a matched filter.

    Attributes:
        statistic: in standard deviations of the noise: normal with variance one, and mean ``sqrt(gain)`` at the
            position of the pattern's first pixel.
        gain: output signal-to-noise ratio, a ratio of powers: the pattern's energy over sigma^2 in white noise.
    """

    statistic: Float[Array, "p q"]
    gain: Float[Array, ""]


class Noise(eqx.Module):
    """Stationary Gaussian noise of mean zero."""

    @abstractmethod
    def density(self, shape: tuple[int, int], dtype: Any) -> Float[Array, "h w"]:
        """Variance of a pixel per frequency of `jnp.fft.fft2` (its mean is the variance of a pixel)."""


class WhiteNoise(Noise):
    """Independent pixels.

    Attributes:
        sigma: standard deviation, gray levels.
    """

    sigma: Float[Array, ""] | float

    def density(self, shape: tuple[int, int], dtype: Any) -> Float[Array, "h w"]:
        """The same at all frequencies."""
        return jnp.full(shape, jnp.asarray(self.sigma, dtype) ** 2)


class ColoredNoise(Noise):
    """Noise of a known spectrum.

    Attributes:
        spectrum: its power spectral density on the grid of `jnp.fft.fft2` of the image, ``E |fft2(n)|^2 / (h w)``.
    """

    spectrum: Float[Array, "h w"]

    def density(self, shape: tuple[int, int], dtype: Any) -> Float[Array, "h w"]:
        """The spectrum."""
        if self.spectrum.shape != shape:
            raise ValueError(f"ColoredNoise: a spectrum of shape {self.spectrum.shape} for an image of shape {shape}.")
        return self.spectrum.astype(dtype)


@filter_jit
def respond(image: Num[Array, "h w"] | Any, pattern: Num[Array, "m n"] | Any, *, noise: Noise) -> Response:
    """Filters an image for the greatest signal-to-noise ratio at a pattern.

    With S the pattern's spectrum and N the noise's density, the filter is ``conj(S) / N``: in white noise, correlation
    with the pattern. The output signal-to-noise ratio is ``mean(|S|^2 / N)``: in white noise, the pattern's energy over
    sigma^2.

    Args:
        image: gray levels without background (subtract it); pixels that are not finite are taken as zero.
        pattern: the known signal, gray levels; subtract its mean for invariance to the brightness of the background.
        noise: `WhiteNoise` or `ColoredNoise`.

    Returns:
        The statistic at every position of the pattern's first pixel for which it lies within the image, and the gain.

    Raises:
        ValueError: the pattern is larger than the image, or the noise's spectrum has another shape.

    References:
        Turin, "An introduction to matched filters", 1960; [K-25].

    Example:
        >>> import jax.numpy as jnp
        >>> pattern = jnp.array([[3.0, 4.0]])
        >>> found = respond(jnp.zeros((6, 8)).at[2, 3:5].set(pattern[0]), pattern, noise=WhiteNoise(1.0))
        >>> round(float(found.gain), 2), round(float(found.statistic[2, 3]), 2)
        (25.0, 5.0)
    """
    pattern = as_gray(pattern)
    image = as_gray(image, pattern.dtype)
    if any(n > m for n, m in zip(pattern.shape, image.shape, strict=True)):
        raise ValueError(f"A pattern of shape {pattern.shape} is larger than the image of shape {image.shape}.")
    density = noise.density(image.shape, image.dtype)
    safe = density > 0
    weight = jnp.where(safe, 1.0 / jnp.where(safe, density, 1.0), 0.0)
    spectrum = jnp.fft.fft2(jnp.where(jnp.isfinite(pattern), pattern, 0.0), image.shape)
    product = jnp.fft.fft2(jnp.where(jnp.isfinite(image), image, 0.0)) * jnp.conj(spectrum)
    gain = jnp.mean((spectrum.real**2 + spectrum.imag**2) * weight)
    some = gain > 0
    filtered = jnp.fft.ifft2(product * weight.astype(product.dtype)).real / jnp.sqrt(jnp.where(some, gain, 1.0))
    rows, columns = (side - size + 1 for side, size in zip(image.shape, pattern.shape, strict=True))
    return Response(jnp.where(some, filtered, 0.0)[:rows, :columns], gain)


def threshold(false_alarms: float | Float[Array, ""], *, places: int) -> Float[Array, ""]:
    """Threshold of the statistic for an expected number of false alarms.

    Args:
        false_alarms: expected number in an image; below one, about the probability of any.
        places: number of positions of the pattern.

    Returns:
        Standard deviations: the normal quantile of ``1 - false_alarms / places``.

    References:
        Neyman and Pearson's test; [K-25].

    Example:
        >>> round(float(threshold(0.01, places=10_000)), 2)
        4.75
    """
    return -ndtri(jnp.asarray(false_alarms, float) / places)
