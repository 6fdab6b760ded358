"""Image values between pixels: bilinear and bicubic sampling, differentiable in the image and in the coordinates."""

from abc import abstractmethod

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


class Sampled(eqx.Module):
    """Values of an image at a set of pixel coordinates.

    Attributes:
        values: One value (or one row of channels) a point; zero where the point lies outside.
        inside: True where the point lies on the image, `0 <= u <= w - 1` and `0 <= v <= h - 1`.
    """

    values: Float[Array, "n *c"]
    inside: Bool[Array, " n"]


class AbstractInterpolation(eqx.Module):
    """How the value between pixels is weighted from its neighbors, the same along rows and columns."""

    first: eqx.AbstractClassVar[int]
    taps: eqx.AbstractClassVar[int]

    @abstractmethod
    def weights(self, fraction: Float[Array, "*n"]) -> tuple[Float[Array, "*n"], ...]:
        """Weights of the pixels `floor(x) + first ... floor(x) + first + taps - 1` for `fraction = x - floor(x)`."""


class Bilinear(AbstractInterpolation):
    """Two pixels a direction: continuous, with a gradient that jumps at pixel centers."""

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


@eqx.filter_jit
def sample(
    image: Float[Array, "h w *c"], uv: Float[Array, "n 2"], *, method: AbstractInterpolation | None = None
) -> Sampled:
    """Reads an image between its pixels.

    `I(u, v) = sum_ij w_i(v) w_j(u) I[floor(v) + i, floor(u) + j]`; neighbors beyond the border repeat the border pixel.
    A point outside the image (or not finite) gives zero, is flagged, and has no gradient.

    Args:
        image: Grey image, or one with any channels behind rows and columns (color, range, ...).
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
    method = Bilinear() if method is None else method
    height, width = image.shape[:2]
    inside = inside_image(uv, (height, width))
    safe = jnp.where(inside[:, None], uv, 0.0)
    columns, weights_u = _neighbors(safe[:, 0], width, method)
    rows, weights_v = _neighbors(safe[:, 1], height, method)
    flat = image.reshape(height * width, *image.shape[2:])
    values = jnp.zeros((uv.shape[0], *image.shape[2:]), dtype=image.dtype)
    for row, weight_v in zip(rows, weights_v, strict=True):
        for column, weight_u in zip(columns, weights_u, strict=True):
            weight = jnp.where(inside, weight_v * weight_u, 0.0).astype(image.dtype)
            picked = flat.at[row * width + column].get(mode="promise_in_bounds")
            values = values + weight.reshape(weight.shape + (1,) * (image.ndim - 2)) * picked
    return Sampled(values, inside)


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
    # The last cell takes its closed end, so that a coordinate on the far border still has a gradient.
    base = jnp.clip(jnp.floor(coordinate).astype(jnp.int32), 0, max(size - 2, 0))
    fraction = coordinate - base.astype(coordinate.dtype)
    indices = [jnp.clip(base + method.first + tap, 0, size - 1) for tap in range(method.taps)]
    return indices, method.weights(fraction)
