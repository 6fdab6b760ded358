"""Image spectra: Hann window, amplitudes, and log-polar sampling [R-33, R-34]."""

import math
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxloc._jit import filter_jit
from jaxloc.images.interpolation import Bilinear, sample


def hann(shape: tuple[int, int], dtype: Any = float) -> Float[Array, "h w"]:
    """Hann window: one at the center, zero half a pixel beyond the border.

    Example:
        >>> hann((3, 3)).round(2)[1].tolist()
        [0.25, 1.0, 0.25]
    """
    rows, columns = (jnp.sin(jnp.pi * (jnp.arange(side, dtype=dtype) + 0.5) / side) ** 2 for side in shape)
    return rows[:, None] * columns[None, :]


@filter_jit
def amplitude(image: Float[Array, "h w"]) -> Float[Array, "h w"]:
    """Amplitude spectrum ``|fft2(image)|``, invariant to circular shifts.

    Args:
        image: gray levels.

    Returns:
        Amplitudes in the order of `jnp.fft.fft2`, with finite derivatives at zeros.

    References:
        [R-33].

    Example:
        >>> import jax, jax.numpy as jnp
        >>> image = jax.random.uniform(jax.random.key(0), (8, 9))
        >>> bool(jnp.allclose(amplitude(image), amplitude(jnp.roll(image, (3, 4), (0, 1))), atol=1e-4))
        True
    """
    spectrum = jnp.fft.fft2(image)
    power = spectrum.real**2 + spectrum.imag**2
    some = power > 0
    return jnp.where(some, jnp.sqrt(jnp.where(some, power, 1.0)), 0.0)


class LogPolar(eqx.Module):
    """Sampling of an amplitude spectrum in logarithmic polar coordinates: rotation and scale become translations.

    Attributes:
        angles: static number of rows, over half a turn.
        radii: static number of columns.
        lowest: least radius, cycles per pixel.
        highest: greatest radius.
    """

    angles: int = eqx.field(static=True, default=256)
    radii: int = eqx.field(static=True, default=256)
    lowest: float = eqx.field(static=True, default=0.02)
    highest: float = eqx.field(static=True, default=0.45)

    def sample(self, amplitudes: Float[Array, "h w"]) -> Float[Array, "a r"]:
        """Logarithms of high-passed amplitudes: rows are angles of (right, down), columns radii.

        Example:
            >>> import jax.numpy as jnp
            >>> LogPolar(angles=32, radii=16).sample(jnp.ones((64, 64))).shape
            (32, 16)
        """
        rows, columns = amplitudes.shape
        dtype = amplitudes.dtype
        angle = jnp.pi * jnp.arange(self.angles, dtype=dtype) / self.angles
        radius = self.lowest * jnp.exp(self._log_step * jnp.arange(self.radii, dtype=dtype))
        u = radius[None, :] * jnp.cos(angle)[:, None] * columns + columns // 2
        v = radius[None, :] * jnp.sin(angle)[:, None] * rows + rows // 2
        safe = jnp.log(1.0 + jnp.fft.fftshift(amplitudes) / jnp.maximum(jnp.mean(amplitudes), 1e-6))
        read = sample(safe, jnp.stack([u.reshape(-1), v.reshape(-1)], axis=1), method=Bilinear())
        values = read.values.reshape(self.angles, self.radii)
        # The mean decrease of spectra is isotropic: only deviations from it depend on rotation and scale.
        return values * (radius / self.highest)[None, :]

    def tapered(self, polar: Float[Array, "a r"]) -> Float[Array, "a r"]:
        """Zero mean, and tapered towards both ends of the radii; angles are periodic."""
        fade = jnp.sin(jnp.pi * (jnp.arange(self.radii, dtype=polar.dtype) + 0.5) / self.radii) ** 2
        return (polar - jnp.mean(polar, axis=0)[None, :]) * fade[None, :]

    def turn(self, shift: Float[Array, "2"]) -> Float[Array, "2"]:
        """Angle (right to down) and logarithm of scale of an image, from the shift (radii, angles) of its spectrum."""
        return shift[::-1] * self.steps(shift.dtype) * jnp.array([1.0, -1.0], dtype=shift.dtype)

    def steps(self, dtype: Any = float) -> Float[Array, "2"]:
        """Angle and log-radius from one sample to the next."""
        return jnp.array([math.pi / self.angles, self._log_step], dtype=dtype)

    @property
    def _log_step(self) -> float:
        return math.log(self.highest / self.lowest) / (self.radii - 1)
