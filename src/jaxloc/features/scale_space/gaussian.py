"""Gaussian scale space: octaves of blurred images, their differences, and the Laplacian of Gaussian."""

import math

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxloc._jit import filter_jit
from jaxloc.images.gradients import smooth


class Octave(eqx.Module):
    """Layers of one resolution.

    Attributes:
        layers: the image at growing blur, one a layer, gray levels.
        differences: of neighboring layers, the wider less the narrower.
        step: distance of two pixels of the octave, px of the image.
    """

    layers: Float[Array, "s h w"]
    differences: Float[Array, "t h w"]
    step: float = eqx.field(static=True)


class ScaleSpace(eqx.Module):
    """Sampling of a Gaussian scale space.

    Attributes:
        octave_layers: layers an octave (three more are computed for the extrema).
        sigma: blur of the first layer, px of its octave.
        camera_sigma: blur that the image has already, px.
        doubled: the first octave is the image at twice its size: four times as many points and time.
        least_side: shorter side of the last octave, px.

    References:
        Lowe, "Distinctive image features from scale-invariant keypoints", IJCV 2004, section 3 [R-27].
    """

    octave_layers: int = eqx.field(static=True, default=3)
    sigma: float = eqx.field(static=True, default=1.6)
    camera_sigma: float = eqx.field(static=True, default=0.5)
    doubled: bool = eqx.field(static=True, default=True)
    least_side: int = eqx.field(static=True, default=16)

    @property
    def ratio(self) -> float:
        """Ratio of neighboring scales."""
        return 2.0 ** (1.0 / self.octave_layers)

    def blurs(self) -> tuple[float, ...]:
        """Blur of each layer of an octave, px of the octave."""
        return tuple(self.sigma * self.ratio**k for k in range(self.octave_layers + 3))


@filter_jit
def laplacian(image: Float[Array, "h w"], sigma: float) -> Float[Array, "h w"]:
    """Scale-normalized Laplacian of Gaussian, ``sigma^2 (d_uu + d_vv) G_sigma * I``.

    The response to a blob does not depend on its size when sigma is proportional to it. The kernels are exact
    derivatives of a sampled Gaussian, in separable passes.

    Args:
        image: gray levels.
        sigma: blur, px; static.

    Returns:
        Gray levels; negative on bright blobs. For a disc of radius r it is least at ``sigma = r / sqrt(2)``.

    References:
        Lindeberg, "Feature detection with automatic scale selection", IJCV 1998; thesis eq. 2.28 (whose Gaussian lacks
        the minus sign in the exponent) [T-27].

    Example:
        >>> import jax.numpy as jnp
        >>> u, v = jnp.meshgrid(jnp.arange(41.0) - 20, jnp.arange(41.0) - 20)
        >>> blob = 100.0 * jnp.exp(-(u**2 + v**2) / (2 * 4.0**2))
        >>> round(float(laplacian(blob, 4.0)[20, 20]))  # half of the height, for sigma of the blob
        -50
    """
    radius = max(1, min(math.ceil(4.0 * sigma), min(image.shape) - 1))
    offsets = jnp.arange(-radius, radius + 1, dtype=image.dtype)
    gauss = jnp.exp(-0.5 * (offsets / sigma) ** 2)
    gauss = gauss / jnp.sum(gauss)
    second = gauss * ((offsets / sigma) ** 2 - 1.0)
    # Correction of truncation: exact for constants and parabolas.
    second = second - jnp.mean(second)
    second = second * 2.0 * sigma**2 / jnp.sum(second * offsets**2)
    padded = jnp.pad(image, radius, mode="reflect")

    def convolve(weights: Array, across: Array) -> Array:
        height, width = image.shape
        rows = sum(weights[i] * padded[i : i + height] for i in range(2 * radius + 1))
        return sum(across[j] * rows[:, j : j + width] for j in range(2 * radius + 1))

    return convolve(second, gauss) + convolve(gauss, second)


@filter_jit
def difference_of_gaussians(image: Float[Array, "h w"], sigma: float, ratio: float) -> Float[Array, "h w"]:
    """``(G_(k sigma) - G_sigma) * I``, which is ``(k - 1)`` times the scale-normalized Laplacian, to first order.

    By the heat equation ``dG / dsigma = sigma laplace G``.

    Args:
        image: gray levels.
        sigma: smaller blur, px; static.
        ratio: k, greater than one; static.

    References:
        Lowe 2004, section 3; thesis eq. 2.29-2.32 [T-28].

    Example:
        >>> import jax.numpy as jnp
        >>> bool(jnp.all(jnp.abs(difference_of_gaussians(jnp.ones((16, 16)), 1.0, 1.2)) < 1e-6))
        True
    """
    narrow, wide = (smooth(image, s, radius=_kernel_radius(s, image.shape)) for s in (sigma, ratio * sigma))
    return wide - narrow


def _kernel_radius(sigma: float, shape: tuple[int, ...]) -> int:
    return max(1, min(math.ceil(4.0 * sigma), min(shape) - 1))


def double(image: Float[Array, "h w"]) -> Float[Array, "h2 w2"]:
    """The image at twice its size by linear interpolation; pixel (u, v) becomes (2 u, 2 v)."""

    def along(values: Float[Array, "n m"]) -> Float[Array, "n2 m"]:
        following = jnp.concatenate([values[1:], values[-1:]])
        return jnp.stack([values, 0.5 * (values + following)], axis=1).reshape(2 * values.shape[0], values.shape[1])

    return along(along(image).T).T


@filter_jit
def octaves(image: Float[Array, "h w"], options: ScaleSpace) -> tuple[Octave, ...]:
    """The octaves of an image, finest first.

    Args:
        image: gray levels.
        options: sampling of the scales.

    Returns:
        Octaves down to `least_side`; at least one.

    Example:
        >>> import jax.numpy as jnp
        >>> [(o.layers.shape, o.step) for o in octaves(jnp.ones((20, 40)), ScaleSpace())]
        [((6, 40, 80), 0.5), ((6, 20, 40), 1.0)]
    """
    step, have = (0.5, 2.0 * options.camera_sigma) if options.doubled else (1.0, options.camera_sigma)
    base = double(image) if options.doubled else image
    missing = math.sqrt(max(options.sigma**2 - have**2, 1e-4))
    base = smooth(base, missing, radius=_kernel_radius(missing, base.shape))
    blurs, found = options.blurs(), []
    while not found or min(base.shape) >= options.least_side:
        stack = _blur_layers(base, blurs)
        found.append(Octave(stack, stack[1:] - stack[:-1], step))
        # The next octave begins with every second pixel of the layer with twice the blur.
        base, step = stack[options.octave_layers][::2, ::2], 2.0 * step
    return tuple(found)


def _blur_layers(base: Float[Array, "h w"], blurs: tuple[float, ...]) -> Float[Array, "s h w"]:
    """The layers of an octave, each blurred from the one before: one loop, which compiles faster than five kernels."""
    more = [math.sqrt(after**2 - before**2) for before, after in zip(blurs[:-1], blurs[1:], strict=True)]
    radius = _kernel_radius(max(more), base.shape)

    def blur(layer: Array, sigma: Array) -> tuple[Array, Array]:
        wider = smooth(layer, sigma, radius=radius)
        return wider, wider

    _, layers = lax.scan(blur, base, jnp.asarray(more, base.dtype))
    return jnp.concatenate([base[None], layers])
