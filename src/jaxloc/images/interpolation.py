"""Bilinear and bicubic interpolation of images, differentiable in the image and in the coordinates."""

from abc import abstractmethod

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxloc._jit import filter_jit


class Sampled(eqx.Module):
    """Values of an image at a set of pixel coordinates.

    Attributes:
        values: One value (or one row of channels) a point; zero where the point lies outside.
        inside: True where the point lies on the image, `0 <= u <= w - 1` and `0 <= v <= h - 1`.
    """

    values: Float[Array, "n *c"]
    inside: Bool[Array, " n"]


class AbstractInterpolation(eqx.Module):
    """Interpolation kernel, the same along rows and columns."""

    first: eqx.AbstractClassVar[int]
    taps: eqx.AbstractClassVar[int]

    @abstractmethod
    def weights(self, fraction: Float[Array, "*n"]) -> tuple[Float[Array, "*n"], ...]:
        """Weights of the pixels `floor(x) + first ... floor(x) + first + taps - 1` for `fraction = x - floor(x)`."""

    def noise_gain(self, uv: Float[Array, "*n 2"]) -> Float[Array, "*n"]:
        """Variance of interpolated white noise over that of the pixels, `sum w^2` along rows times columns.

        Example:
            >>> import jax.numpy as jnp
            >>> Bilinear().noise_gain(jnp.array([[3.0, 0.5], [0.5, 1.5]])).tolist()
            [0.5, 0.25]
        """
        return jnp.prod(sum(w * w for w in self.weights(uv - jnp.floor(uv))), axis=-1)


class Bilinear(AbstractInterpolation):
    """Two pixels a direction: continuous, with a gradient that is discontinuous at pixel centers."""

    first = 0
    taps = 2

    def weights(self, fraction: Float[Array, "*n"]) -> tuple[Float[Array, "*n"], ...]:
        """Weights `(1 - t, t)`."""
        return 1.0 - fraction, fraction


class Bicubic(AbstractInterpolation):
    """Four pixels a direction with Keys' kernel: continuous gradient.

    Attributes:
        a: Slope of the kernel at one pixel: -0.5 (Catmull-Rom) is third-order accurate, -0.75 is OpenCV's choice.

    References:
        Keys, "Cubic convolution interpolation for digital image processing" (1981), eq. 15.
    """

    first = -1
    taps = 4
    a: float = eqx.field(static=True, default=-0.5)

    def weights(self, fraction: Float[Array, "*n"]) -> tuple[Float[Array, "*n"], ...]:
        """Keys' kernel at the distances `1 + t, t, 1 - t, 2 - t`."""
        t, rest, a = fraction, 1.0 - fraction, self.a
        return a * t * rest * rest, self._near(t), self._near(rest), a * rest * t * t

    def _near(self, t: Float[Array, "*n"]) -> Float[Array, "*n"]:
        return ((self.a + 2.0) * t - (self.a + 3.0)) * t * t + 1.0


@filter_jit
def sample(
    image: Float[Array, "h w *c"], uv: Float[Array, "n 2"], *, method: AbstractInterpolation | None = None
) -> Sampled:
    """Samples an image at subpixel coordinates.

    `I(u, v) = sum_ij w_i(v) w_j(u) I[floor(v) + i, floor(u) + j]`; neighbors beyond the border repeat the border pixel.
    A point outside the image (or not finite) gives zero, is flagged, and has no gradient.

    Args:
        image: Grayscale image, or with channels after rows and columns (color, range, ...).
        uv: Pixel coordinates (right, down), centers at integers.
        method: `Bilinear()` (the default) or `Bicubic()`.

    Returns:
        The values in the image's dtype, and which points lie inside.

    References:
        Image measurements of any channels [K-10]; Keys (1981) for the cubic kernel.

    Example:
        >>> import jax.numpy as jnp
        >>> from jaxloc.images.interpolation import sample
        >>> image = jnp.array([[0.0, 1.0], [2.0, 3.0]])
        >>> sampled = sample(image, jnp.array([[0.5, 0.5], [7.0, 0.0]]))
        >>> sampled.values.tolist(), sampled.inside.tolist()
        ([1.5, 0.0], [True, False])
    """
    values, inside = sample_components(image, uv[:, 0], uv[:, 1], method=Bilinear() if method is None else method)
    return Sampled(values, inside)


def sample_components(
    image: Float[Array, "h w *c"], u: Float[Array, " n"], v: Float[Array, " n"], *, method: AbstractInterpolation
) -> tuple[Float[Array, "n *c"], Bool[Array, " n"]]:
    """`sample` on component arrays, for inner loops: values and which points lie inside."""
    height, width = image.shape[:2]
    inside = (u >= 0) & (u <= width - 1) & (v >= 0) & (v <= height - 1)
    columns, weights_u = _neighbors(jnp.where(inside, u, 0.0), width, method)
    rows, weights_v = _neighbors(jnp.where(inside, v, 0.0), height, method)
    flat, trailing = image.reshape(height * width, *image.shape[2:]), (1,) * (image.ndim - 2)

    def along(row: Int[Array, " n"]) -> Float[Array, "n *c"]:
        picked = [flat.at[row * width + column].get(mode="promise_in_bounds") for column in columns]
        return sum(_as_channels(weight, image, trailing) * part for weight, part in zip(weights_u, picked, strict=True))

    values = sum(
        _as_channels(weight, image, trailing) * along(row) for weight, row in zip(weights_v, rows, strict=True)
    )
    return jnp.where(inside.reshape(inside.shape + trailing), values, 0.0), inside


def _as_channels(weight: Float[Array, " n"], image: Array, axes: tuple[int, ...]) -> Float[Array, "n *one"]:
    return weight.astype(image.dtype).reshape(weight.shape + axes)


def inside_image(uv: Float[Array, "n 2"], shape: tuple[int, int]) -> Bool[Array, " n"]:
    """Which pixel coordinates lie on an image of `shape = (rows, columns)`, borders included.

    Example:
        >>> import jax.numpy as jnp
        >>> inside_image(jnp.array([[0.0, 4.0], [0.0, 4.1]]), (5, 5)).tolist()
        [True, False]
    """
    u, v = uv[:, 0], uv[:, 1]
    return (u >= 0) & (u <= shape[1] - 1) & (v >= 0) & (v <= shape[0] - 1)


def _neighbors(coordinate: Float[Array, " n"], size: int, method: AbstractInterpolation):
    """Indices (border repeated) and weights of the pixels that surround each coordinate."""
    # The last cell includes its end, so that a coordinate on the far border has a gradient.
    base = jnp.clip(jnp.floor(coordinate).astype(jnp.int32), 0, max(size - 2, 0))
    fraction = coordinate - base.astype(coordinate.dtype)
    # Two neighbors of a cell are never outside an image of at least two pixels.
    near = method.first == 0 and method.taps <= min(size, 2)
    indices = [base + tap if near else jnp.clip(base + method.first + tap, 0, size - 1) for tap in range(method.taps)]
    return indices, method.weights(fraction)
