"""How alike a template and every place of an image are: sums over the template by convolution or Fourier transform.

Local means and energies come from additions only (windows doubled in width), never from differences of running sums, so
that float32 keeps its digits on bright images and in flat places.
"""

from abc import abstractmethod
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float


class Correlator(eqx.Module):
    """How ``c(t) = sum_x k(x) I(x + t)`` is computed for all shifts t that keep the kernel on the image."""

    @abstractmethod
    def correlate(self, image: Float[Array, "h w"], kernel: Float[Array, "m n"]) -> Float[Array, "p q"]:
        """The correlation, of shape (h - m + 1, w - n + 1)."""


class Direct(Correlator):
    """Multiplies and adds at every place: best for templates up to about 32x32."""

    def correlate(self, image: Float[Array, "h w"], kernel: Float[Array, "m n"]) -> Float[Array, "p q"]:
        """By convolution."""
        found = lax.conv_general_dilated(image[None, None], kernel[None, None], (1, 1), "VALID", precision="highest")
        return found[0, 0]


class Fourier(Correlator):
    """Multiplies spectra: the time does not grow with the template."""

    def correlate(self, image: Float[Array, "h w"], kernel: Float[Array, "m n"]) -> Float[Array, "p q"]:
        """By fast Fourier transforms; what wraps around the border is cut off."""
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
    """An image and a template, ready to be compared.

    Attributes:
        image: gray levels, finite.
        template: gray levels, finite.
        mask: weights of the template's pixels, or None for all of them.
        by: how sums are computed.
    """

    image: Float[Array, "h w"]
    template: Float[Array, "m n"]
    mask: Float[Array, "m n"] | None
    by: Correlator

    @property
    def count(self) -> Float[Array, ""]:
        """Number of template pixels that count."""
        total = jnp.asarray(float(self.template.size), self.template.dtype) if self.mask is None else self.mask.sum()
        return jnp.maximum(total, 1.0)

    def over_mask(self, image: Float[Array, "h w"]) -> Float[Array, "p q"]:
        """Sums of an image over the template's pixels, at every place."""
        if self.mask is None:
            return _box_moments(image, self.template.shape)[0]
        return self.by.correlate(image, self.mask)

    def centered(self, offset: Float[Array, ""]) -> "Pair":
        """Both without a common offset; masked template pixels are zero."""
        template = self.template - offset
        template = template if self.mask is None else template * self.mask
        return Pair(self.image - offset, template, self.mask, self.by)

    def zero_mean(self) -> Float[Array, "m n"]:
        """The template without its mean, what rounding leaves of that included.

        First without its brightest pixel, which is exact: the mean of a bright template is rounded, and not alike
        wherever a compiler computes it anew.
        """
        counts = jnp.ones(self.template.shape, bool) if self.mask is None else self.mask > 0
        brightest = jnp.max(self.template, where=counts, initial=jnp.min(self.template))
        near = self.centered(lax.stop_gradient(brightest))
        once = near.centered(near.mean())
        return once.centered(once.mean()).template

    def mean(self) -> Float[Array, ""]:
        """Of the template's pixels that count."""
        template = self.template if self.mask is None else self.template * self.mask
        return template.sum() / self.count


class Score(eqx.Module):
    """A measure of likeness of template and image.

    Class attribute `best_is_least` tells distances from correlations.
    """

    best_is_least: ClassVar[bool] = False

    @abstractmethod
    def surface(self, pair: Pair) -> Float[Array, "p q"]:
        """The measure at every place."""

    @abstractmethod
    def worst(self, pair: Pair) -> Float[Array, ""]:
        """The measure given to places with unknown pixels."""


class SumOfSquares(Score):
    """``sum (I - T)^2``: the least is best; gray levels have to be the same in both images."""

    best_is_least = True

    def surface(self, pair: Pair) -> Float[Array, "p q"]:
        """Sums of squares, below zero by rounding at most."""
        pair = pair.centered(pair.mean())
        energy = pair.over_mask(pair.image * pair.image)
        return energy - 2.0 * pair.by.correlate(pair.image, pair.template) + jnp.sum(pair.template**2)

    def worst(self, pair: Pair) -> Float[Array, ""]:
        """The largest sum that the range of gray levels allows."""
        high = jnp.maximum(pair.image.max(), pair.template.max())
        return lax.stop_gradient(pair.count * (high - jnp.minimum(pair.image.min(), pair.template.min())) ** 2)


class NormalizedCorrelation(Score):
    """``sum I T / sqrt(sum I^2 sum T^2)``: blind to contrast, not to brightness. In [-1, 1], 0 if one is black."""

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
        """No likeness."""
        return jnp.zeros((), pair.image.dtype)


class ZeroMeanCorrelation(Score):
    """Correlation coefficient: blind to gain and bias. In [-1, 1], 0 where either is flat [K-22]."""

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
        """No likeness."""
        return jnp.zeros((), pair.image.dtype)


def _rounding(pair: Pair) -> Float[Array, ""]:
    """Sum of squares that rounding alone leaves, in units of the squared brightness."""
    return pair.count * (16.0 * float(jnp.finfo(pair.image.dtype).eps)) ** 2


def _variance_sums(pair: Pair) -> Float[Array, "p q"]:
    """Sums of squares about the local mean."""
    if pair.mask is None:
        return _box_moments(pair.image, pair.template.shape)[1]
    sums = pair.over_mask(pair.image)
    spread = pair.over_mask(pair.image * pair.image) - sums * sums / pair.count
    # The difference of two large numbers: what rounding may have left is taken for nothing.
    floor = 64.0 * float(jnp.finfo(sums.dtype).eps) * pair.count * jnp.max(pair.image**2)
    return jnp.where(spread > floor, spread, 0.0)


def _box_moments(image: Array, size: tuple[int, int]) -> tuple[Float[Array, "p q"], Float[Array, "p q"]]:
    """Sums, and sums of squares about the mean, over windows of `size = (rows, columns)` at every place.

    Windows are joined two by two (Chan, Golub, LeVeque, 1979), first along columns, then along rows: additions only.
    """
    sums, spread, count = image, jnp.zeros_like(image), 1
    for axis, length in enumerate(size):
        sums, spread = _extend(sums, spread, count, length, axis)
        count *= length
    return sums, spread


def _extend(sums: Array, spread: Array, count: int, length: int, axis: int) -> tuple[Array, Array]:
    """Joins `length` windows of `count` pixels each that follow each other along an axis."""
    done, reach = None, 0
    power = 1
    while power <= length:
        if length & power:
            done = (
                (sums, spread)
                if done is None
                else _join(done, (sums, spread), count * reach, count * power, reach, axis)
            )
            reach += power
        power *= 2
        if power <= length:
            sums, spread = _join(
                (sums, spread), (sums, spread), count * power // 2, count * power // 2, power // 2, axis
            )
    return done


def _join(first: tuple, second: tuple, count: int, other: int, shift: int, axis: int) -> tuple[Array, Array]:
    """Moments of windows and of those `shift` pixels on, together."""
    length = second[0].shape[axis] - shift
    length = min(length, first[0].shape[axis])
    (sums, spread), (sums_on, spread_on) = (
        [lax.slice_in_dim(part, start, start + length, axis=axis) for part in parts]
        for parts, start in ((first, 0), (second, shift))
    )
    apart = sums_on / other - sums / count
    return sums + sums_on, spread + spread_on + apart * apart * (count * other / (count + other))


def unknown_places(finite: Bool[Array, "h w"], size: tuple[int, int]) -> Bool[Array, "p q"]:
    """Where a window of `size = (rows, columns)` holds a pixel that is not finite.

    Example:
        >>> import jax.numpy as jnp
        >>> unknown_places(jnp.ones((3, 3), bool).at[0, 0].set(False), (2, 2)).tolist()
        [[True, False], [False, False]]
    """
    return lax.stop_gradient(_box_moments((~finite).astype(jnp.float32), size)[0]) > 0.5
