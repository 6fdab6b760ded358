"""KAZE and A-KAZE in JAX: blobs of a nonlinear scale space, whose edges stay where they are.

References:
    Alcantarilla, Bartoli, Davison, "KAZE features", ECCV 2012; Alcantarilla, Nuevo, Bartoli, "Fast explicit diffusion
    for accelerated features in nonlinear scale spaces", BMVC 2013.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxloc.features.kaze_words import MLdb, MSurf, Words
from jaxloc.features.keypoints import Descriptors, Keypoints
from jaxloc.features.scale_space.extrema import ExtremumTest, find_extrema
from jaxloc.features.scale_space.nonlinear import DiffusedScaleSpace, Samples, Stack, read, samples_of, seat_of, stacks
from jaxloc.features.scale_space.orientation import disc, dominant_direction

# Radius of the orientation and deviation of its Gaussian, in samples.
_RADIUS, _SPREAD = 6, 2.5
# Maxima that are looked at for each slot: many lie on ridges, where the paraboloid's vertex runs away, or have rivals.
_SURPLUS = 4
# Keypoints of neighboring layers, whose sizes differ by less, are rivals.
_ALIKE = 1.35


class Kaze(eqx.Module):
    """What KAZE looks for.

    Attributes:
        scales: the nonlinear scale space.
        words: descriptors, `MSurf` or `MLdb`.
        flat: a keypoint is a maximum of its layer with no stronger one near it in the next layers (A-KAZE), not a
            maximum over place and scale (KAZE).
        least_response: least determinant of a keypoint, as a share of 255^2.
        upright: all keypoints point to the right: for cameras that do not roll.
    """

    scales: DiffusedScaleSpace = DiffusedScaleSpace()
    words: Words = MSurf()
    flat: bool = eqx.field(static=True, default=False)
    least_response: float = eqx.field(static=True, default=1e-3)
    upright: bool = eqx.field(static=True, default=False)

    @classmethod
    def accelerated(cls) -> "Kaze":
        """A-KAZE: octaves sampled by halves, fast explicit diffusion, binary descriptors.

        Example:
            >>> type(Kaze.accelerated().words).__name__
            'MLdb'
        """
        return cls(DiffusedScaleSpace.accelerated(), MLdb(), flat=True)


@eqx.filter_jit
def kaze(image: Float[Array, "h w"], *, options: Kaze = Kaze(), capacity: int = 1000) -> tuple[Keypoints, Descriptors]:
    """Keypoints with scale and orientation, and their descriptors.

    Maxima of the determinant of the Hessian, moved to the vertex of a paraboloid, unless a stronger one of about their
    size lies within the reach of their derivatives; their direction is that of most derivatives within a window of 60
    degrees.

    Args:
        image: gray levels 0-255.
        options: what to look for; `Kaze.accelerated()` is A-KAZE.
        capacity: keypoints that are kept, the strongest first.

    Returns:
        Keypoints and their descriptors. ``size`` is twice the reach, as in OpenCV: 2 blurs for KAZE, 3 for A-KAZE.

    References:
        Alcantarilla et al. 2012, 2013 [T-43, T-48...T-50].

    Example:
        >>> import jax.numpy as jnp
        >>> u, v = jnp.meshgrid(jnp.arange(64.0), jnp.arange(64.0))
        >>> image = 60 + 120 * jnp.exp(-((u - 30.3) ** 2 + 1.3 * (v - 33.6) ** 2) / 18)
        >>> keypoints, descriptors = kaze(image, options=Kaze.accelerated(), capacity=4)
        >>> [round(float(x)) for x in keypoints.uv[0]], descriptors.values.shape
        ([30, 34], (4, 61))
    """
    found = stacks(image, options.scales)
    samples = samples_of(found)
    keypoints = _strongest(found, options, capacity)
    if not options.upright:
        keypoints = eqx.tree_at(lambda k: k.angle, keypoints, _directions(samples, keypoints, options.scales))
    return keypoints, _describe(samples, keypoints, options)


@eqx.filter_jit
def describe_kaze(image: Float[Array, "h w"], keypoints: Keypoints, *, options: Kaze = Kaze()) -> Descriptors:
    """Descriptors of any keypoints with a size and an angle, read from the nonlinear scale space.

    Args:
        image: gray levels 0-255.
        keypoints: `size` is twice the reach of derivatives.
        options: the scale space and the descriptors.

    Returns:
        64 numbers of length one (`MSurf`) or 61 bytes (`MLdb`) a keypoint; zero where not valid.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> image = jax.random.uniform(jax.random.key(0), (64, 64), maxval=255.0)
        >>> points = Keypoints.from_uv(jnp.array([[30.0, 30.0]]), size=6.0)
        >>> describe_kaze(image, points, options=Kaze.accelerated()).values.dtype
        dtype('uint8')
    """
    return _describe(samples_of(stacks(image, options.scales)), keypoints, options)


def _strongest(found: tuple[Stack, ...], options: Kaze, capacity: int) -> Keypoints:
    """The strongest maxima of the determinants of all stacks."""
    scales, shape, parts = options.scales, found[0].layers.shape[1:], []
    # A ridge of the determinant is no edge of the image.
    test = ExtremumTest(255.0**2 * options.least_response, edge_ratio=1e6, minima=False, flat=options.flat)
    for stack in found:
        blobs = find_extrema(stack.determinant, test, capacity=_SURPLUS * capacity)
        sigma = scales.sigma * stack.step * jnp.exp2(blobs.place[:, 0] / scales.layers)
        uv = stack.step * blobs.place[:, :0:-1]
        # What its second derivatives reach lies within the image: large blobs at the border are seldom found again.
        far = jnp.asarray([shape[1] - 1, shape[0] - 1], uv.dtype)[None, :]
        room = jnp.min(jnp.minimum(uv, far - uv), axis=1)
        parts.append((uv, sigma, blobs.value, blobs.valid & (room >= 2.0 * scales.reach * sigma)))
    uv, sigma, value, valid = (jnp.concatenate(column) for column in zip(*parts, strict=True))
    _, best = lax.top_k(lax.stop_gradient(jnp.where(valid, value, -1.0)), min(_SURPLUS * capacity, value.shape[0]))
    uv, sigma, value, valid = uv[best], sigma[best], value[best], valid[best]
    valid = valid & ~_has_rival(*lax.stop_gradient((uv, sigma)), valid, scales.reach)
    kept = jnp.argsort(~valid, stable=True)[:capacity]
    uv, sigma, value, valid = uv[kept], sigma[kept], value[kept], valid[kept]
    size, none = jnp.where(valid, 2.0 * scales.reach * sigma, 0.0), jnp.zeros(valid.shape, jnp.int32)
    return Keypoints(uv, size, jnp.zeros_like(size), value, none, none, valid, "kaze")


def _has_rival(uv: Array, sigma: Array, valid: Array, reach: float) -> Bool[Array, " n"]:
    """Whether a keypoint that comes before is of about the same size and near: large blobs have several maxima."""
    squared = sum((uv[:, None, k] - uv[None, :, k]) ** 2 for k in (0, 1))
    ratio = sigma[:, None] / sigma[None, :]
    alike = (ratio < _ALIKE) & (ratio > 1.0 / _ALIKE)
    index = jnp.arange(valid.shape[0])
    near = squared < (reach * sigma[:, None]) ** 2
    return jnp.any(near & alike & valid[None, :] & (index[None, :] < index[:, None]), axis=1)


def _around(samples: Samples, keypoints: Keypoints, scales: DiffusedScaleSpace, side: tuple, angle: Array) -> tuple:
    """Values on samples (right, down) about each keypoint, turned by an angle."""
    sigma = jnp.where(keypoints.valid, keypoints.size / (2.0 * scales.reach), scales.sigma)
    seat = seat_of(samples, keypoints.uv, sigma, scales)
    right, down = (jnp.asarray(axis, sigma.dtype)[None, :] for axis in side)
    cos, sin = (f(angle)[:, None] * seat.reach[:, None] for f in (jnp.cos, jnp.sin))
    u = seat.uv[:, :1] + cos * right - sin * down
    v = seat.uv[:, 1:] + sin * right + cos * down
    return read(samples, seat, u, v)


def _directions(samples: Samples, keypoints: Keypoints, scales: DiffusedScaleSpace) -> Float[Array, " n"]:
    columns, rows = (np.array(side) for side in disc(_RADIUS))
    values, inside = _around(samples, keypoints, scales, (columns, rows), jnp.zeros_like(keypoints.size))
    weight = jnp.asarray(np.exp(-0.5 * (columns**2 + rows**2) / _SPREAD**2), values.dtype)[None, :]
    weight = jnp.where(inside, weight, 0.0)
    direction = dominant_direction(weight * values[:, :, 1], weight * values[:, :, 2])
    return jnp.where(keypoints.valid & direction.ok, direction.angle, 0.0)


def _describe(samples: Samples, keypoints: Keypoints, options: Kaze) -> Descriptors:
    middle = np.arange(options.words.side) - 0.5 * (options.words.side - 1)
    rows, columns = (axis.reshape(-1) for axis in np.meshgrid(middle, middle, indexing="ij"))
    values, inside = _around(samples, keypoints, options.scales, (columns, rows), keypoints.angle)
    words = options.words.of(values, inside, keypoints.angle)
    slopes = jnp.sum(jnp.where(inside[:, :, None], jnp.abs(values[:, :, 1:]), 0.0), axis=(1, 2))
    valid = keypoints.valid & (slopes > 0)
    return Descriptors(jnp.where(valid[:, None], words, jnp.zeros((), words.dtype)), valid)
