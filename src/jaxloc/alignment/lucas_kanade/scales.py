"""Coarse-to-fine schedules: pyramids, blurred images, or the full size only."""

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
        margin: width of the template's border that smoothing mixes with extrapolated pixels, px.
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
    """A single scale: the images themselves."""

    def of(self, image: Float[Array, "h w"], template: Float[Array, "p q"]) -> list[Scaled]:
        """The images."""
        return [Scaled(image, template, 1, 0)]


class Pyramid(Scales):
    """Image pyramid; each level has half the size of the next.

    Attributes:
        levels: number of levels, the full size included; fewer for small templates (see `least`).
        least: least length of the shorter side of the coarsest template, px.

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
    """Full-sized images with decreasing blur, for templates too small for a pyramid.

    Attributes:
        sigmas: standard deviations of the Gaussians, px, decreasing; 0 is the image itself.
    """

    sigmas: tuple[float, ...] = eqx.field(static=True, default=(4.0, 2.0, 0.0))

    def of(self, image: Float[Array, "h w"], template: Float[Array, "p q"]) -> list[Scaled]:
        """The smoothed images."""
        pairs = [(smooth(image, s), smooth(template, s)) if s > 0 else (image, template) for s in self.sigmas]
        return [Scaled(*pair, 1, round(s)) for pair, s in zip(pairs, self.sigmas, strict=True)]
