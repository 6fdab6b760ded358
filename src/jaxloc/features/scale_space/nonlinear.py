"""The nonlinear scale space: an image at every time of a diffusion that stops at edges, and its determinant."""

import math
from abc import abstractmethod
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

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

# Shorter side of the smallest octave, px; what the contrast loses with each octave that is sampled by halves.
_LEAST_SIDE, _CONTRAST_LOSS = 40, 0.75
# Blur before derivatives, px of the stack.
_SMOOTHING = 1.0


class Scheme(eqx.Module):
    """How diffusion is integrated from one layer to the next."""

    @abstractmethod
    def steps(self, times: tuple[float, ...]) -> np.ndarray:
        """Steps "layers n" that last these times; zeros fill up."""

    @abstractmethod
    def advance(self, image: Float[Array, "h w"], conductance: Float[Array, "h w"], steps: Array) -> Array:
        """The image after the steps."""


class Splitting(Scheme):
    """Additive operator splitting: one implicit step a layer, as in KAZE [T-48]."""

    def steps(self, times: tuple[float, ...]) -> np.ndarray:
        """The times themselves."""
        return np.array(times)[:, None]

    def advance(self, image: Float[Array, "h w"], conductance: Float[Array, "h w"], steps: Array) -> Array:
        """One step."""
        return diffuse_implicit(image, conductance, steps[0])


class ExplicitCycle(Scheme):
    """Fast explicit diffusion: one cycle a layer, as in A-KAZE [T-49]."""

    def steps(self, times: tuple[float, ...]) -> np.ndarray:
        """Cycles of `fed_steps`; steps of no time fill up short ones."""
        cycles = [fed_steps(time) for time in times]
        return np.array([cycle + (0.0,) * (max(map(len, cycles)) - len(cycle)) for cycle in cycles])

    def advance(self, image: Float[Array, "h w"], conductance: Float[Array, "h w"], steps: Array) -> Array:
        """One cycle."""
        return diffuse_explicit(image, conductance, steps)


class DiffusedScaleSpace(eqx.Module):
    """How a nonlinear scale space is sampled.

    Attributes:
        octaves: most octaves, each twice the blur of the last; as many as the image has room for.
        layers: layers in which a scale doubles.
        sigma: blur of the first layer, px.
        halved: sample each octave by half of the last (A-KAZE); else all at full size (KAZE).
        scheme: of integration.
        conductivity: where the diffusion stops.
        percentile: of the image's gradients, which divides edges from noise.
        reach: of derivatives, blurs; half of a keypoint's size.

    References:
        Alcantarilla, Bartoli, Davison, "KAZE features", ECCV 2012, section 2; Alcantarilla, Nuevo, Bartoli, "Fast
        explicit diffusion for accelerated features in nonlinear scale spaces", BMVC 2013 [T-43, T-48, T-49].
    """

    octaves: int = eqx.field(static=True, default=4)
    layers: int = eqx.field(static=True, default=4)
    sigma: float = eqx.field(static=True, default=1.6)
    halved: bool = eqx.field(static=True, default=False)
    scheme: Scheme = Splitting()
    conductivity: Conductivity = PeronaMalik()
    percentile: float = eqx.field(static=True, default=70.0)
    reach: float = eqx.field(static=True, default=1.0)

    @classmethod
    def accelerated(cls, octaves: int = 4) -> "DiffusedScaleSpace":
        """That of A-KAZE.

        Args:
            octaves: most octaves.

        Example:
            >>> DiffusedScaleSpace.accelerated().reach
            1.5
        """
        return cls(octaves, halved=True, scheme=ExplicitCycle(), reach=1.5)

    def stacks(self, shape: tuple[int, ...]) -> tuple[int, int]:
        """How many stacks of layers there are, and in how many layers of one the extrema lie."""
        room = max(1, 1 + math.floor(math.log2(max(min(shape) / _LEAST_SIDE, 1.0))))
        octaves = min(self.octaves, room)
        return (octaves, self.layers) if self.halved else (1, octaves * self.layers)

    def blurs(self, count: int) -> tuple[float, ...]:
        """Blur of each layer of a stack with extrema in `count` layers, px of the stack."""
        return tuple(self.sigma * 2.0 ** (k / self.layers) for k in range(count + 2))


class Stack(eqx.Module):
    """Layers of one sampling of an image.

    Attributes:
        layers: the diffused image, gray levels.
        right: derivative along rows over the layer's reach, gray levels a pixel of the stack.
        down: along columns.
        determinant: of the Hessian times the fourth power of the reach, squared gray levels.
        step: distance of two pixels of the stack, px of the image.
    """

    layers: Float[Array, "s h w"]
    right: Float[Array, "s h w"]
    down: Float[Array, "s h w"]
    determinant: Float[Array, "s h w"]
    step: float = eqx.field(static=True)


@eqx.filter_jit
def stacks(image: Float[Array, "h w"], options: DiffusedScaleSpace) -> tuple[Stack, ...]:
    """The nonlinear scale space of an image, finest stack first.

    Args:
        image: gray levels.
        options: sampling, scheme and conductivity.

    Returns:
        Stacks; extrema of the determinant lie in their inner layers.

    Example:
        >>> import jax.numpy as jnp
        >>> options = DiffusedScaleSpace.accelerated()
        >>> [(s.layers.shape, s.step) for s in stacks(jnp.ones((90, 80)), options)]
        [((6, 90, 80), 1.0), ((6, 45, 40), 2.0)]
    """
    image = jnp.where(jnp.isfinite(image), image, 0.0)
    number, count = options.stacks(image.shape)
    edge = contrast(image, percentile=options.percentile)
    blurs, base, found = options.blurs(count), smooth(image, options.sigma), []
    for k in range(number):
        layers = _diffused(base, edge, blurs, options)
        found.append(Stack(layers, *_derivatives(layers, [options.reach * blur for blur in blurs]), step=2.0**k))
        if k + 1 < number:
            base, edge = halve(layers[options.layers]), _CONTRAST_LOSS * edge
    return tuple(found)


def _diffused(base: Array, edge: Array, blurs: tuple[float, ...], options: DiffusedScaleSpace) -> Float[Array, "s h w"]:
    """The layers of a stack, each diffused from the one before for half the growth of the squared blur."""
    times = tuple(0.5 * (after**2 - before**2) for before, after in zip(blurs[:-1], blurs[1:], strict=True))

    def advance(layer: Array, steps: Array) -> tuple[Array, Array]:
        flow = conductance(layer, edge, kind=options.conductivity)
        later = options.scheme.advance(layer, flow, steps)
        return later, later

    _, layers = lax.scan(advance, base, jnp.asarray(options.scheme.steps(times), base.dtype))
    return jnp.concatenate([base[None], layers])


def _derivatives(layers: Float[Array, "s h w"], wanted: list[float]) -> tuple[Array, Array, Array]:
    """First derivatives of all layers and their determinants, by Scharr's kernel spread over the layer's reach."""
    _, height, width = layers.shape
    reaches = [max(1, round(reach)) for reach in wanted]
    margin = min(max(reaches), (min(height, width) - 1) // 2)
    reaches = [min(reach, margin) for reach in reaches]

    def of(item: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        layer, reach, scale = item
        wide = jnp.pad(smooth(layer, _SMOOTHING), 2 * margin, mode="reflect")
        right, down = _scharr(wide, reach, margin, (height + 2 * margin, width + 2 * margin))
        uu, uv = _scharr(right, reach, margin, (height, width))
        _, vv = _scharr(down, reach, margin, (height, width))
        inner = slice(margin, margin + height), slice(margin, margin + width)
        return right[inner], down[inner], (uu * vv - uv * uv) * scale

    # One program for all layers: it compiles faster than one a reach.
    # Responses of neighboring layers are alike when the reach before rounding makes them free of scale.
    scales = jnp.asarray([reach**4 for reach in wanted], layers.dtype)
    return lax.map(of, (layers, jnp.asarray(reaches, jnp.int32), scales))


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


class Samples(NamedTuple):
    """All layers of all stacks, one after the other, and where each lies.

    Attributes:
        values: gray level and both derivatives.
        start: first entry of each (stack, layer).
        shape: (rows, columns) of each stack.
    """

    values: Float[Array, "m 3"]
    start: Int[Array, "o s"]
    shape: Int[Array, "o 2"]


def samples_of(found: tuple[Stack, ...]) -> Samples:
    """Lays the stacks out for reading."""
    parts, starts, start = [], [], 0
    for stack in found:
        count, height, width = stack.layers.shape
        channels = stack.layers, stack.right, stack.down
        parts.append(jnp.stack([channel.reshape(-1) for channel in channels], axis=1))
        starts.append([start + k * height * width for k in range(count)])
        start += stack.layers.size
    shapes = [stack.layers.shape[1:] for stack in found]
    return Samples(jnp.concatenate(parts), jnp.asarray(starts, jnp.int32), jnp.asarray(shapes, jnp.int32))


class Seat(NamedTuple):
    """The layer that belongs to a keypoint, and the keypoint there, in pixels of the stack.

    Attributes:
        start: first entry of the layer.
        shape: (rows, columns).
        uv: "n 2".
        reach: distance of two samples.
    """

    start: Int[Array, " n"]
    shape: Int[Array, "n 2"]
    uv: Float[Array, "n 2"]
    reach: Float[Array, " n"]


def seat_of(samples: Samples, uv: Array, sigma: Float[Array, " n"], options: DiffusedScaleSpace) -> Seat:
    """The layer whose blur is nearest to sigma (px of the image)."""
    number, several = samples.start.shape
    level = options.layers * jnp.log2(jnp.maximum(lax.stop_gradient(sigma), 1e-3) / options.sigma)
    stack = jnp.clip(jnp.floor((level - 0.5) / options.layers), 0, number - 1).astype(jnp.int32)
    layer = jnp.round(level - (options.layers * stack).astype(level.dtype))
    layer = jnp.clip(layer, 0, several - 1).astype(jnp.int32)
    step = jnp.exp2(stack.astype(sigma.dtype))
    return Seat(samples.start[stack, layer], samples.shape[stack], uv / step[:, None], options.reach * sigma / step)


def read(samples: Samples, seat: Seat, u: Float[Array, "n k"], v: Float[Array, "n k"]) -> tuple[Array, Array]:
    """Values "n k 3" between pixels of each keypoint's layer (at the border outside), and which lie inside "n k"."""
    height, width = seat.shape[:, :1], seat.shape[:, 1:]
    bounded_u = jnp.clip(u, 0.0, (width - 1).astype(u.dtype))
    bounded_v = jnp.clip(v, 0.0, (height - 1).astype(v.dtype))
    column = jnp.clip(jnp.floor(lax.stop_gradient(bounded_u)).astype(jnp.int32), 0, width - 2)
    row = jnp.clip(jnp.floor(lax.stop_gradient(bounded_v)).astype(jnp.int32), 0, height - 2)
    part_u, part_v = bounded_u - column.astype(u.dtype), bounded_v - row.astype(v.dtype)
    flat = seat.start[:, None] + row * width + column
    corners = (
        (flat, (1.0 - part_u) * (1.0 - part_v)),
        (flat + 1, part_u * (1.0 - part_v)),
        (flat + width, (1.0 - part_u) * part_v),
        (flat + width + 1, part_u * part_v),
    )
    values = sum(samples.values[index] * share[:, :, None] for index, share in corners)
    return values, (bounded_u == u) & (bounded_v == v)
