"""Nonlinear scale space of KAZE and A-KAZE: layers of edge-stopping diffusion and their Hessian determinants."""

import math
from abc import abstractmethod

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from jaxloc._jit import filter_jit
from jaxloc.images.diffusion import (
    Conductivity,
    PeronaMalik,
    conductance,
    contrast,
    diffuse_explicit,
    diffuse_implicit,
    fed_steps,
)
from jaxloc.images.gradients import smooth
from jaxloc.images.pyramid import halve

# Shorter side of the smallest octave, px; factor of the contrast parameter from one halved octave to the next.
_LEAST_SIDE, _CONTRAST_LOSS = 40, 0.75
# Gaussian blur before derivatives, px of the stack.
_SMOOTHING = 1.0


class DiffusionScheme(eqx.Module):
    """Integration of the diffusion equation from one layer to the next."""

    @abstractmethod
    def steps(self, times: tuple[float, ...]) -> np.ndarray:
        """Time steps "layers n" whose sums are these times, padded with zeros."""

    @abstractmethod
    def advance(self, image: Float[Array, "h w"], conductance: Float[Array, "h w"], steps: Array) -> Array:
        """The image after the steps."""


class OperatorSplitting(DiffusionScheme):
    """Additive operator splitting: one implicit step a layer, as in KAZE [T-48]."""

    def steps(self, times: tuple[float, ...]) -> np.ndarray:
        """One step a layer: the times themselves."""
        return np.array(times)[:, None]

    def advance(self, image: Float[Array, "h w"], conductance: Float[Array, "h w"], steps: Array) -> Array:
        """One implicit step."""
        return diffuse_implicit(image, conductance, steps[0])


class FastExplicitDiffusion(DiffusionScheme):
    """Fast explicit diffusion: one cycle a layer, as in A-KAZE [T-49]."""

    def steps(self, times: tuple[float, ...]) -> np.ndarray:
        """Cycles of `fed_steps`; short ones are padded with zeros."""
        cycles = [fed_steps(time) for time in times]
        return np.array([cycle + (0.0,) * (max(map(len, cycles)) - len(cycle)) for cycle in cycles])

    def advance(self, image: Float[Array, "h w"], conductance: Float[Array, "h w"], steps: Array) -> Array:
        """One cycle of explicit steps."""
        return diffuse_explicit(image, conductance, steps)


class NonlinearScaleSpace(eqx.Module):
    """Sampling of a nonlinear scale space.

    Attributes:
        octaves: greatest number of octaves, each twice the blur of the last; fewer in small images.
        layers: layers an octave.
        sigma: blur of the first layer, px.
        halved: each octave has half the resolution of the last (A-KAZE); else all are at full size (KAZE).
        scheme: numerical integration.
        conductivity: conductivity function, which stops the diffusion at edges.
        percentile: of the gradient magnitudes, which is the contrast parameter between noise and edges.
        reach: half-width of the derivative kernels, in blurs; half of a keypoint's size.

    References:
        Alcantarilla, Bartoli, Davison, "KAZE features", ECCV 2012, section 2; Alcantarilla, Nuevo, Bartoli, "Fast
        explicit diffusion for accelerated features in nonlinear scale spaces", BMVC 2013 [T-43, T-48, T-49].
    """

    octaves: int = eqx.field(static=True, default=4)
    layers: int = eqx.field(static=True, default=4)
    sigma: float = eqx.field(static=True, default=1.6)
    halved: bool = eqx.field(static=True, default=False)
    scheme: DiffusionScheme = OperatorSplitting()
    conductivity: Conductivity = PeronaMalik()
    percentile: float = eqx.field(static=True, default=70.0)
    reach: float = eqx.field(static=True, default=1.0)

    @classmethod
    def akaze(cls, octaves: int = 4) -> "NonlinearScaleSpace":
        """The scale space of A-KAZE.

        Args:
            octaves: greatest number of octaves.

        Example:
            >>> NonlinearScaleSpace.akaze().reach
            1.5
        """
        return cls(octaves, halved=True, scheme=FastExplicitDiffusion(), reach=1.5)

    def layout(self, shape: tuple[int, ...]) -> tuple[int, int]:
        """Number of stacks of layers, and number of inner layers of a stack, in which extrema are sought."""
        room = max(1, 1 + math.floor(math.log2(max(min(shape) / _LEAST_SIDE, 1.0))))
        octaves = min(self.octaves, room)
        return (octaves, self.layers) if self.halved else (1, octaves * self.layers)

    def blurs(self, count: int) -> tuple[float, ...]:
        """Blur of each layer of a stack with `count` inner layers, px of the stack."""
        return tuple(self.sigma * 2.0 ** (k / self.layers) for k in range(count + 2))


class Stack(eqx.Module):
    """Layers of one resolution.

    Attributes:
        layers: the diffused image, gray levels.
        right: derivative along rows, by a kernel as wide as the layer's reach, gray levels a pixel of the stack.
        down: along columns.
        determinant: of the Hessian times the fourth power of the reach, squared gray levels.
        step: distance of two pixels of the stack, px of the image.
    """

    layers: Float[Array, "s h w"]
    right: Float[Array, "s h w"]
    down: Float[Array, "s h w"]
    determinant: Float[Array, "s h w"]
    step: float = eqx.field(static=True)


@filter_jit
def nonlinear_scale_space(image: Float[Array, "h w"], options: NonlinearScaleSpace) -> tuple[Stack, ...]:
    """The nonlinear scale space of an image, finest stack first.

    Args:
        image: gray levels.
        options: sampling, scheme and conductivity.

    Returns:
        Stacks of layers; extrema of the determinant are sought in their inner layers.

    Example:
        >>> import jax.numpy as jnp
        >>> options = NonlinearScaleSpace.akaze()
        >>> [(s.layers.shape, s.step) for s in nonlinear_scale_space(jnp.ones((90, 80)), options)]
        [((6, 90, 80), 1.0), ((6, 45, 40), 2.0)]
    """
    image = jnp.where(jnp.isfinite(image), image, 0.0)
    number, count = options.layout(image.shape)
    edge = contrast(image, percentile=options.percentile)
    blurs, base, found = options.blurs(count), smooth(image, options.sigma), []
    for k in range(number):
        layers = _diffuse_layers(base, edge, blurs, options)
        found.append(Stack(layers, *_derivatives(layers, [options.reach * blur for blur in blurs]), step=2.0**k))
        if k + 1 < number:
            base, edge = halve(layers[options.layers]), _CONTRAST_LOSS * edge
    return tuple(found)


def _diffuse_layers(
    base: Array, edge: Array, blurs: tuple[float, ...], options: NonlinearScaleSpace
) -> Float[Array, "s h w"]:
    """The layers of a stack, each diffused from the one before for half the growth of the squared blur."""
    times = tuple(0.5 * (after**2 - before**2) for before, after in zip(blurs[:-1], blurs[1:], strict=True))

    def advance(layer: Array, steps: Array) -> tuple[Array, Array]:
        flow = conductance(layer, edge, kind=options.conductivity)
        later = options.scheme.advance(layer, flow, steps)
        return later, later

    _, layers = lax.scan(advance, base, jnp.asarray(options.scheme.steps(times), base.dtype))
    return jnp.concatenate([base[None], layers])


def _derivatives(layers: Float[Array, "s h w"], wanted: list[float]) -> tuple[Array, Array, Array]:
    """First derivatives of all layers and their determinants, by Scharr's kernel dilated to the layer's reach."""
    _, height, width = layers.shape
    reaches = [max(1, round(reach)) for reach in wanted]
    margin = min(max(reaches), (min(height, width) - 1) // 2)
    reaches = [min(reach, margin) for reach in reaches]

    def differentiate(item: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        layer, reach, scale = item
        wide = jnp.pad(smooth(layer, _SMOOTHING), 2 * margin, mode="reflect")
        right, down = _scharr(wide, reach, margin, (height + 2 * margin, width + 2 * margin))
        uu, uv = _scharr(right, reach, margin, (height, width))
        _, vv = _scharr(down, reach, margin, (height, width))
        inner = slice(margin, margin + height), slice(margin, margin + width)
        return right[inner], down[inner], (uu * vv - uv * uv) * scale

    # One program for all layers: it compiles faster than one a reach.
    # Normalizing by the reach before rounding keeps the responses of neighboring layers comparable.
    scales = jnp.asarray([reach**4 for reach in wanted], layers.dtype)
    return lax.map(differentiate, (layers, jnp.asarray(reaches, jnp.int32), scales))


def _scharr(image: Array, reach: Int[Array, ""], margin: int, shape: tuple[int, int]) -> tuple[Array, Array]:
    """Derivatives between samples `reach` apart on both sides of the inner part of an image."""

    def at(down: int, right: int) -> Array:
        return lax.dynamic_slice(image, (margin + down * reach, margin + right * reach), shape)

    corner = {(a, b): at(a, b) for a in (-1, 0, 1) for b in (-1, 0, 1) if a or b}
    weight = 1.0 / (32.0 * reach.astype(image.dtype))
    diagonal, other = corner[1, 1] - corner[-1, -1], corner[-1, 1] - corner[1, -1]
    right = weight * (3.0 * (diagonal + other) + 10.0 * (corner[0, 1] - corner[0, -1]))
    down = weight * (3.0 * (diagonal - other) + 10.0 * (corner[1, 0] - corner[-1, 0]))
    return right, down
