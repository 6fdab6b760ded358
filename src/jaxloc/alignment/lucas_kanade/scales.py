"""From coarse to fine: at which scales two images are compared, one after the other."""

from abc import abstractmethod

import equinox as eqx
from jaxtyping import Array, Float

from jaxloc.images.gradients import smooth
from jaxloc.images.pyramid import gaussian_pyramid


class Scaled(eqx.Module):
    """Both images at one scale.

    Attributes:
        image: the smoothed or smaller image.
        template: the smoothed or smaller template.
        factor: pixels of the full images to one of these.
        margin: pixels along the border of the template that smoothing has mixed with what it made up beyond it.
    """

    image: Float[Array, "h w"]
    template: Float[Array, "p q"]
    factor: int = eqx.field(static=True)
    margin: int = eqx.field(static=True)


class Scales(eqx.Module):
    """A list of scales, the coarsest first."""

    @abstractmethod
    def of(self, image: Float[Array, "h w"], template: Float[Array, "p q"]) -> list[Scaled]:
        """Both images at each scale."""


class FullSize(Scales):
    """Only the images themselves."""

    def of(self, image: Float[Array, "h w"], template: Float[Array, "p q"]) -> list[Scaled]:
        """The images."""
        return [Scaled(image, template, 1, 0)]


class Pyramid(Scales):
    """Smaller images, each half the size of the next.

    Attributes:
        levels: their number, the full size included; fewer where an image would be left with less than `least` pixels.
        least: pixels that the shorter side of the coarsest template has at least.

    References:
        Burt and Adelson, "The Laplacian pyramid as a compact image code", 1983.
    """

    levels: int = eqx.field(static=True, default=4)
    least: int = eqx.field(static=True, default=20)

    def of(self, image: Float[Array, "h w"], template: Float[Array, "p q"]) -> list[Scaled]:
        """The levels."""
        shorter = min(*image.shape, *template.shape)
        levels = 1
        while levels < self.levels and shorter / 2**levels >= self.least:
            levels += 1
        pairs = zip(gaussian_pyramid(image, levels=levels), gaussian_pyramid(template, levels=levels), strict=True)
        return [Scaled(*pair, 2**k, min(k, 2)) for k, pair in enumerate(pairs)][::-1]


class Blurred(Scales):
    """Full-sized images, smoothed less and less: for templates too small for a pyramid.

    Attributes:
        sigmas: standard deviations of the Gaussians, px, falling; 0 is the image itself.
    """

    sigmas: tuple[float, ...] = eqx.field(static=True, default=(4.0, 2.0, 0.0))

    def of(self, image: Float[Array, "h w"], template: Float[Array, "p q"]) -> list[Scaled]:
        """The smoothed images."""
        pairs = [(smooth(image, s), smooth(template, s)) if s > 0 else (image, template) for s in self.sigmas]
        return [Scaled(*pair, 1, round(s)) for pair, s in zip(pairs, self.sigmas, strict=True)]
