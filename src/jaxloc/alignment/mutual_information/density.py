"""Mutual information of two images, and their joint density.

The joint density of both is a histogram smoothed with cubic B-splines (Parzen windows), so that mutual information has
derivatives.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Num

from jaxloc._jit import filter_jit
from jaxloc._linalg import matmul
from jaxloc.images.normalization import as_gray

_LEAST_BINS = 5


@filter_jit
def mutual_information(
    a: Num[Array, "h w"] | Any,
    b: Num[Array, "h w"] | Any,
    *,
    bins: int = 32,
    mask: Num[Array, "h w"] | Bool[Array, "h w"] | None = None,
) -> Float[Array, ""]:
    """Mutual information of the gray levels of two images, ``sum p(a, b) log(p(a, b) / (p(a) p(b)))``.

    The joint density is a histogram in which each pixel pair has weights in 4x4 bins by cubic B-splines. The range of
    gray levels, least to greatest, is taken from the images and has no derivative.

    Args:
        a: gray levels; pixels that are not finite in either image are ignored.
        b: gray levels.
        bins: static number of bins of each image, at least 5.
        mask: weights of pixels.

    Returns:
        Nats; zero for a flat image. Smoothing makes it less than that of the gray levels themselves.

    Raises:
        ValueError: images or mask differ in shape, or there are too few bins.

    References:
        Viola and Wells, "Alignment by maximization of mutual information", IJCV 24(2), 1997; Thevenaz and Unser, 2000,
        for B-splines [R-35].

    Example:
        >>> import jax, jax.numpy as jnp
        >>> image = jax.random.uniform(jax.random.key(0), (64, 64))
        >>> other = jax.random.uniform(jax.random.key(1), (64, 64))
        >>> bool(mutual_information(image, 1 - image**2) > 1.0), bool(mutual_information(image, other) < 0.2)
        (True, True)
    """
    a = as_gray(a)
    b = as_gray(b, a.dtype)
    weight = pixel_weights(a, mask, bins)
    if b.shape != a.shape:
        raise ValueError(f"mutual_information: images of shapes {a.shape} and {b.shape} differ.")
    weight = jnp.where(jnp.isfinite(b), weight, 0.0)
    known = weight > 0
    of_a, of_b = (Binning.of(jnp.where(known, x, 0.0), known, bins) for x in (a, b))
    values = [jnp.where(known, x, 0.0).reshape(-1) for x in (a, b)]
    density = joint_density(of_a.weights(values[0]), of_b.weights(values[1]), weight.reshape(-1))
    return jnp.sum(density * log_ratio(density))


def pixel_weights(template: Array, mask: Any, bins: int) -> Float[Array, "p q"]:
    """Weights of an image's pixels, zero where not finite; raises for a mask of another shape and too few bins."""
    if bins < _LEAST_BINS:
        raise ValueError(f"Mutual information with {bins} bins: cubic B-splines need at least {_LEAST_BINS}.")
    if mask is not None and mask.shape != template.shape:
        raise ValueError(f"A mask of shape {mask.shape} does not fit an image of shape {template.shape}.")
    weight = jnp.ones_like(template) if mask is None else jnp.asarray(mask).astype(template.dtype)
    return jnp.where(jnp.isfinite(template), weight, 0.0)


class Binning(eqx.Module):
    """Map from gray levels to positions on the bins, ``1 ... bins - 2``, and B-spline weights of the bins."""

    low: Float[Array, ""]
    per_level: Float[Array, ""]
    bins: int = eqx.field(static=True)

    @staticmethod
    def of(values: Array, known: Array, bins: int) -> "Binning":
        """The bins between the least and the greatest known value."""
        values = lax.stop_gradient(values)
        high, low = jnp.max(jnp.where(known, values, -jnp.inf)), jnp.min(jnp.where(known, values, jnp.inf))
        # Rounding errors of a constant image are no texture.
        level = jnp.maximum(jnp.abs(high), jnp.abs(low))
        textured = high - low > 32.0 * float(jnp.finfo(values.dtype).eps) * level
        span = jnp.where(textured, high - low, 1.0)
        return Binning(jnp.where(jnp.isfinite(low), low, 0.0), jnp.where(textured, (bins - 3) / span, 0.0), bins)

    def distances(self, values: Float[Array, " n"]) -> Float[Array, "b n"]:
        """From each value to each bin, in bins."""
        position = jnp.clip(1.0 + self.per_level * (values - self.low), 1.0, self.bins - 2.0)
        return position[None, :] - jnp.arange(self.bins, dtype=values.dtype)[:, None]

    def weights(self, values: Float[Array, " n"]) -> Float[Array, "b n"]:
        """Weights of the bins."""
        return _spline(self.distances(values))

    def weights_with_derivatives(self, values: Float[Array, " n"]) -> tuple[Array, Array, Array]:
        """Weights of the bins, and their first and second derivatives by the gray level."""
        x = self.distances(values)
        sign, size = jnp.sign(x), jnp.abs(x)
        near, far = size < 1.0, size < 2.0
        first = jnp.where(near, (1.5 * size - 2.0) * size, jnp.where(far, -0.5 * (2.0 - size) ** 2, 0.0))
        second = jnp.where(near, 3.0 * size - 2.0, jnp.where(far, 2.0 - size, 0.0))
        return _spline(x), sign * first * self.per_level, second * self.per_level**2


def _spline(x: Array) -> Array:
    """The centered cubic B-spline."""
    size = jnp.abs(x)
    inner = 2.0 / 3.0 + (0.5 * size - 1.0) * size * size
    rest = jnp.maximum(2.0 - size, 0.0)
    return jnp.where(size < 1.0, inner, rest * rest * rest / 6.0)


def joint_density(
    of_a: Float[Array, "b n"], of_b: Float[Array, "b n"], weight: Float[Array, " n"]
) -> Float[Array, "b b"]:
    """Smoothed histogram of both, from the bin weights of n pixels each."""
    total = jnp.sum(weight)
    return matmul(of_a * weight[None], of_b.T) / jnp.where(total > 0, total, 1.0)


def log_ratio(density: Float[Array, "b b"], *, conditional: bool = False) -> Float[Array, "b b"]:
    """``log p(a, b) / (p(a) p(b))``, or ``log p(a, b) / p(b)``; zero in empty bins."""
    product = jnp.sum(density, axis=0)[None, :] * (1.0 if conditional else jnp.sum(density, axis=1)[:, None])
    product = jnp.broadcast_to(product, density.shape)
    some = (density > 1e-12) & (product > 1e-18)
    return jnp.where(some, jnp.log(jnp.where(some, density, 1.0) / jnp.where(some, product, 1.0)), 0.0)
