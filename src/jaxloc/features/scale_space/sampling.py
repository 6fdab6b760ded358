"""Bilinear sampling of the layers of a scale space around keypoints, each in the layer that matches its scale."""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int


class LayerSamples(NamedTuple):
    """Pixels of all layers of all octaves in one array, and where each layer begins.

    Attributes:
        values: channels of every pixel, for example gray level and derivatives.
        start: first entry of each (octave, layer).
        shape: (rows, columns) of each octave.
        step: distance of two pixels of each octave, px of the image.
    """

    values: Float[Array, "m c"]
    start: Int[Array, "o s"]
    shape: Int[Array, "o 2"]
    step: Float[Array, " o"]


class KeypointLayer(NamedTuple):
    """The layer that matches a keypoint's scale, and the keypoint in pixels of that layer.

    Attributes:
        start: first entry of the layer in `LayerSamples.values`.
        shape: (rows, columns).
        uv: position of the keypoint.
        sigma: blur of the keypoint.
    """

    start: Int[Array, " n"]
    shape: Int[Array, "n 2"]
    uv: Float[Array, "n 2"]
    sigma: Float[Array, " n"]


def concatenate_layers(octaves: Sequence[tuple[Float[Array, "s _ _"], ...]], steps: Sequence[float]) -> LayerSamples:
    """Lays the channels of all octaves out in one array.

    Args:
        octaves: channels of each octave.
        steps: distance of two pixels of each octave, px of the image.

    Example:
        >>> import jax.numpy as jnp
        >>> samples = concatenate_layers([(jnp.ones((2, 4, 5)),), (jnp.ones((2, 2, 3)),)], [1.0, 2.0])
        >>> samples.values.shape, samples.start.tolist()
        ((52, 1), [[0, 20], [40, 46]])
    """
    parts, starts, start = [], [], 0
    for channels in octaves:
        count, height, width = channels[0].shape
        parts.append(jnp.stack([channel.reshape(-1) for channel in channels], axis=1))
        starts.append([start + k * height * width for k in range(count)])
        start += count * height * width
    values = jnp.concatenate(parts)
    shapes = np.array([channels[0].shape[1:] for channels in octaves])
    tables = jnp.asarray(np.array(starts), jnp.int32), jnp.asarray(shapes, jnp.int32)
    return LayerSamples(values, *tables, jnp.asarray(np.array(steps), values.dtype))


def nearest_layer(
    samples: LayerSamples, uv: Float[Array, "n 2"], sigma: Float[Array, " n"], *, first_sigma: float, per_octave: int
) -> KeypointLayer:
    """The layer whose blur is nearest to each keypoint's.

    Args:
        samples: of the scale space.
        uv: keypoints, px of the image.
        sigma: their blurs, px of the image.
        first_sigma: blur of the first layer of an octave, px of the octave.
        per_octave: layers in which the blur doubles.

    Example:
        >>> import jax.numpy as jnp
        >>> samples = concatenate_layers([(jnp.ones((6, 9, 9)),), (jnp.ones((6, 4, 4)),)], [1.0, 2.0])
        >>> one = jnp.ones((1, 2)), jnp.array([4.0])
        >>> nearest_layer(samples, *one, first_sigma=1.6, per_octave=4).start.tolist()
        [502]
    """
    number, several = samples.start.shape
    blur = jnp.maximum(lax.stop_gradient(sigma), 1e-3)
    level = per_octave * jnp.log2(blur / (first_sigma * samples.step[0]))
    octave = jnp.clip(jnp.floor((level - 0.5) / per_octave), 0, number - 1).astype(jnp.int32)
    layer = jnp.round(level - (per_octave * octave).astype(level.dtype))
    layer = jnp.clip(layer, 0, several - 1).astype(jnp.int32)
    step = samples.step[octave]
    return KeypointLayer(samples.start[octave, layer], samples.shape[octave], uv / step[:, None], sigma / step)


def interpolate_layer(
    samples: LayerSamples, layer: KeypointLayer, u: Float[Array, "n k"], v: Float[Array, "n k"]
) -> tuple[Float[Array, "n k c"], Bool[Array, "n k"]]:
    """Bilinear interpolation in each keypoint's layer.

    Args:
        samples: of the scale space.
        layer: the layer of each keypoint.
        u: columns, px of the layer.
        v: rows.

    Returns:
        Values, continued by those at the border, and which positions lie inside.

    Example:
        >>> import jax.numpy as jnp
        >>> samples = concatenate_layers([(jnp.arange(20.0).reshape(1, 4, 5),)], [1.0])
        >>> layer = nearest_layer(samples, jnp.ones((1, 2)), jnp.array([1.6]), first_sigma=1.6, per_octave=4)
        >>> [x.tolist() for x in interpolate_layer(samples, layer, jnp.array([[1.5, 9.0]]), jnp.array([[1.0, 1.0]]))]
        [[[[6.5], [9.0]]], [[True, False]]]
    """
    height, width = layer.shape[:, :1], layer.shape[:, 1:]
    bounded_u = jnp.clip(u, 0.0, (width - 1).astype(u.dtype))
    bounded_v = jnp.clip(v, 0.0, (height - 1).astype(v.dtype))
    column = jnp.clip(jnp.floor(lax.stop_gradient(bounded_u)).astype(jnp.int32), 0, width - 2)
    row = jnp.clip(jnp.floor(lax.stop_gradient(bounded_v)).astype(jnp.int32), 0, height - 2)
    part_u, part_v = bounded_u - column.astype(u.dtype), bounded_v - row.astype(v.dtype)
    flat = layer.start[:, None] + row * width + column
    corners = (
        (flat, (1.0 - part_u) * (1.0 - part_v)),
        (flat + 1, part_u * (1.0 - part_v)),
        (flat + width, (1.0 - part_u) * part_v),
        (flat + width + 1, part_u * part_v),
    )
    values = sum(samples.values[index] * share[:, :, None] for index, share in corners)
    return values, (bounded_u == u) & (bounded_v == v)


def oriented_grid(
    uv: Float[Array, "n 2"], angle: Float[Array, " n"], spacing: Float[Array, " n"], right: ArrayLike, down: ArrayLike
) -> tuple[Float[Array, "n k"], Float[Array, "n k"]]:
    """Positions of a sampling grid around each keypoint, rotated with its orientation and scaled.

    Args:
        uv: keypoints.
        angle: their orientations, from the right axis towards down, rad.
        spacing: distance of two samples of each keypoint, px.
        right: offsets "k" along the keypoint's axis, in spacings.
        down: across.

    Returns:
        Columns and rows.

    Example:
        >>> import jax.numpy as jnp
        >>> u, v = oriented_grid(jnp.ones((1, 2)), jnp.array([jnp.pi / 2]), jnp.array([2.0]), jnp.ones(1), jnp.zeros(1))
        >>> [round(float(x[0, 0]), 5) for x in (u, v)]
        [1.0, 3.0]
    """
    right, down = (jnp.asarray(axis, uv.dtype)[None, :] for axis in (right, down))
    cos, sin = (f(angle)[:, None] * spacing[:, None] for f in (jnp.cos, jnp.sin))
    return uv[:, :1] + cos * right - sin * down, uv[:, 1:] + sin * right + cos * down
