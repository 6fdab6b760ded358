"""Similarity scores of a template at all positions of an image, by convolution or Fourier transform.

Local means and energies use additions only (windows doubled in width), never differences of running sums, so
that float32 is accurate on bright images and in flat regions.
"""

from abc import abstractmethod
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float


class Correlator(eqx.Module):
    """Method to compute ``c(t) = sum_x k(x) I(x + t)`` for all shifts t that keep the kernel within the image."""

    @abstractmethod
    def correlate(self, image: Float[Array, "h w"], kernel: Float[Array, "m n"]) -> Float[Array, "p q"]:
        """The correlation, of shape (h - m + 1, w - n + 1)."""


class Direct(Correlator):
    """Direct convolution: fastest for templates up to about 32x32."""

    def correlate(self, image: Float[Array, "h w"], kernel: Float[Array, "m n"]) -> Float[Array, "p q"]:
        """By convolution."""
        found = lax.conv_general_dilated(image[None, None], kernel[None, None], (1, 1), "VALID", precision="highest")
        return found[0, 0]


class Fourier(Correlator):
    """Products of spectra: the time does not depend on the template's size."""

    def correlate(self, image: Float[Array, "h w"], kernel: Float[Array, "m n"]) -> Float[Array, "p q"]:
        """By fast Fourier transforms, without the positions that wrap around the border."""
        shape = tuple(quick_length(side) for side in image.shape)
        product = jnp.fft.rfft2(image, shape) * jnp.conj(jnp.fft.rfft2(kernel, shape))
        rows, columns = (side - size + 1 for side, size in zip(image.shape, kernel.shape, strict=True))
        return jnp.fft.irfft2(product, shape)[:rows, :columns]


def quick_length(length: int) -> int:
    """The least number, not below `length`, without prime factors above five.

    Example:
        >>> quick_length(1241), quick_length(376)
        (1250, 384)
    """
    while True:
        rest = length
        for prime in (2, 3, 5):
            while rest % prime == 0:
                rest //= prime
        if rest == 1:
            return length
        length += 1


class Pair(eqx.Module):
    """An image and a template with finite values.

    Attributes:
        image: gray levels, finite.
        template: gray levels, finite.
        mask: weights of the template's pixels, or None for all of them.
        by: method of the sums.
    """

    image: Float[Array, "h w"]
    template: Float[Array, "m n"]
    mask: Float[Array, "m n"] | None
    by: Correlator

    @property
    def count(self) -> Float[Array, ""]:
        """Sum of the weights of the template's pixels."""
        total = jnp.asarray(float(self.template.size), self.template.dtype) if self.mask is None else self.mask.sum()
        return jnp.maximum(total, 1.0)

    def over_mask(self, image: Float[Array, "h w"]) -> Float[Array, "p q"]:
        """Sums of an image over the template's pixels, at every position."""
        if self.mask is None:
            return _box_moments(image, self.template.shape)[0]
        return self.by.correlate(image, self.mask)

    def centered(self, offset: Float[Array, ""]) -> "Pair":
        """Image and template less a common offset; masked template pixels are zero."""
        template = self.template - offset
        template = template if self.mask is None else template * self.mask
        return Pair(self.image - offset, template, self.mask, self.by)

    def zero_mean(self) -> Float[Array, "m n"]:
        """The template less its mean, corrected for rounding.

        Its brightest pixel is subtracted first, which is exact: the rounded mean of a bright template may differ
        wherever a compiler computes it again.
        """
        counts = jnp.ones(self.template.shape, bool) if self.mask is None else self.mask > 0
        brightest = jnp.max(self.template, where=counts, initial=jnp.min(self.template))
        near = self.centered(lax.stop_gradient(brightest))
        once = near.centered(near.mean())
        return once.centered(once.mean()).template

    def mean(self) -> Float[Array, ""]:
        """Weighted mean of the template."""
        template = self.template if self.mask is None else self.template * self.mask
        return template.sum() / self.count


class Score(eqx.Module):
    """Similarity of template and image.

    The class attribute `best_is_least` is True for distances, False for correlations.
    """

    best_is_least: ClassVar[bool] = False

    @abstractmethod
    def surface(self, pair: Pair) -> Float[Array, "p q"]:
        """The score at every position."""

    @abstractmethod
    def worst(self, pair: Pair) -> Float[Array, ""]:
        """The score of positions with unknown pixels."""


class SumOfSquares(Score):
    """``sum (I - T)^2``: least is best; assumes equal gray levels in both images."""

    best_is_least = True

    def surface(self, pair: Pair) -> Float[Array, "p q"]:
        """Sums of squares, negative at most by rounding."""
        pair = pair.centered(pair.mean())
        energy = pair.over_mask(pair.image * pair.image)
        return energy - 2.0 * pair.by.correlate(pair.image, pair.template) + jnp.sum(pair.template**2)

    def worst(self, pair: Pair) -> Float[Array, ""]:
        """The largest sum that the range of gray levels allows."""
        high = jnp.maximum(pair.image.max(), pair.template.max())
        return lax.stop_gradient(pair.count * (high - jnp.minimum(pair.image.min(), pair.template.min())) ** 2)


class NormalizedCorrelation(Score):
    """``sum I T / sqrt(sum I^2 sum T^2)``: invariant to gain, not to bias. In [-1, 1], 0 if one is black."""

    def surface(self, pair: Pair) -> Float[Array, "p q"]:
        """Cosines."""
        pair = pair.centered(jnp.zeros((), pair.image.dtype))
        energy = pair.over_mask(pair.image * pair.image)
        squares = jnp.sum(pair.template**2)
        level = jnp.max(jnp.abs(pair.image))
        known = (energy > _rounding(pair) * level**2) & (squares > 0)
        scale = jnp.where(known, energy * squares, 1.0)
        return jnp.where(known, pair.by.correlate(pair.image, pair.template) / jnp.sqrt(scale), 0.0)

    def worst(self, pair: Pair) -> Float[Array, ""]:
        """Zero."""
        return jnp.zeros((), pair.image.dtype)


class ZeroMeanCorrelation(Score):
    """Correlation coefficient: invariant to gain and bias. In [-1, 1], 0 where either is flat [K-22]."""

    def surface(self, pair: Pair) -> Float[Array, "p q"]:
        """Coefficients."""
        level = lax.stop_gradient(jnp.max(jnp.abs(pair.image)))
        brightness = lax.stop_gradient(jnp.maximum(jnp.max(jnp.abs(pair.template)), level))
        template = pair.zero_mean()
        pair = pair.centered(lax.stop_gradient(jnp.mean(pair.image)))
        variance = _variance_sums(pair)
        squares = jnp.sum(template**2)
        floor = _rounding(pair) * brightness**2
        known = (variance > floor) & (squares > floor)
        scale = jnp.where(known, variance * squares, 1.0)
        return jnp.where(known, pair.by.correlate(pair.image, template) / jnp.sqrt(scale), 0.0)

    def worst(self, pair: Pair) -> Float[Array, ""]:
        """Zero."""
        return jnp.zeros((), pair.image.dtype)


def _rounding(pair: Pair) -> Float[Array, ""]:
    """Rounding error of a sum of squares, relative to the squared brightness."""
    return pair.count * (16.0 * float(jnp.finfo(pair.image.dtype).eps)) ** 2


def _variance_sums(pair: Pair) -> Float[Array, "p q"]:
    """Sums of squares about the local mean."""
    if pair.mask is None:
        return _box_moments(pair.image, pair.template.shape)[1]
    sums = pair.over_mask(pair.image)
    squares = pair.over_mask(pair.image * pair.image) - sums * sums / pair.count
    # The difference of two large numbers: values within rounding are set to zero.
    floor = 64.0 * float(jnp.finfo(sums.dtype).eps) * pair.count * jnp.max(pair.image**2)
    return jnp.where(squares > floor, squares, 0.0)


def _box_moments(image: Array, size: tuple[int, int]) -> tuple[Float[Array, "p q"], Float[Array, "p q"]]:
    """Sums, and sums of squares about the mean, over windows of `size = (rows, columns)` at every position.

    Windows are joined two by two (Chan, Golub, LeVeque, 1979), first along columns, then along rows: additions only.
    """
    sums, squares, count = image, jnp.zeros_like(image), 1
    for axis, length in enumerate(size):
        sums, squares = _extend(sums, squares, count, length, axis)
        count *= length
    return sums, squares


def _extend(sums: Array, squares: Array, count: int, length: int, axis: int) -> tuple[Array, Array]:
    """Moments of `length` adjacent windows of `count` pixels each, joined along an axis."""
    done, reach = None, 0
    power = 1
    while power <= length:
        if length & power:
            done = (
                (sums, squares)
                if done is None
                else _join(done, (sums, squares), count * reach, count * power, reach, axis)
            )
            reach += power
        power *= 2
        if power <= length:
            sums, squares = _join(
                (sums, squares), (sums, squares), count * power // 2, count * power // 2, power // 2, axis
            )
    return done


def _join(first: tuple, second: tuple, count: int, other: int, shift: int, axis: int) -> tuple[Array, Array]:
    """Joint moments of windows and of those `shift` pixels further."""
    length = second[0].shape[axis] - shift
    length = min(length, first[0].shape[axis])
    (sums, squares), (sums_on, squares_on) = (
        [lax.slice_in_dim(part, start, start + length, axis=axis) for part in parts]
        for parts, start in ((first, 0), (second, shift))
    )
    difference = sums_on / other - sums / count
    return sums + sums_on, squares + squares_on + difference * difference * (count * other / (count + other))


def unknown_places(finite: Bool[Array, "h w"], size: tuple[int, int]) -> Bool[Array, "p q"]:
    """Positions at which a window of `size = (rows, columns)` contains a non-finite pixel.

    Example:
        >>> import jax.numpy as jnp
        >>> unknown_places(jnp.ones((3, 3), bool).at[0, 0].set(False), (2, 2)).tolist()
        [[True, False], [False, False]]
    """
    return lax.stop_gradient(_box_moments((~finite).astype(jnp.float32), size)[0]) > 0.5
