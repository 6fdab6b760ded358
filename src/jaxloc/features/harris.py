"""Harris and Shi-Tomasi corner responses of the structure tensor, and subpixel refinement of their peaks."""

from abc import abstractmethod

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxloc._jit import filter_jit
from jaxloc.images.gradients import convolve_columns, convolve_rows, smooth, sobel


class AbstractWindow(eqx.Module):
    """Weights by which the structure tensor is averaged over a neighborhood."""

    @abstractmethod
    def average(self, image: Float[Array, "h w"]) -> Float[Array, "h w"]:
        """The weighted mean around every pixel."""


class Box(AbstractWindow):
    """Equal weights over a square.

    Attributes:
        size: Odd side of the square, px.
    """

    size: int = eqx.field(static=True, default=3)

    def __check_init__(self):
        if self.size % 2 == 0:
            raise ValueError(f"Box: the side must be odd, so that the window has a center; got {self.size}.")

    def average(self, image: Float[Array, "h w"]) -> Float[Array, "h w"]:
        """Mean over the square."""
        weights = jnp.full(self.size, 1.0 / self.size, dtype=image.dtype)
        return convolve_columns(convolve_rows(image, weights), weights)


class GaussianWindow(AbstractWindow):
    """Gaussian weights: an isotropic response.

    Attributes:
        sigma: Standard deviation, px.
    """

    sigma: float = eqx.field(static=True, default=1.5)

    def average(self, image: Float[Array, "h w"]) -> Float[Array, "h w"]:
        """Gaussian mean."""
        return smooth(image, self.sigma)


class StructureTensor(eqx.Module):
    """The symmetric matrix `M = mean [[Iu Iu, Iu Iv], [Iu Iv, Iv Iv]]` of every pixel.

    Attributes:
        uu: Mean squared derivative along rows, (gray levels / px)^2.
        uv: Mean product of both derivatives.
        vv: Mean squared derivative along columns.
    """

    uu: Float[Array, "h w"]
    uv: Float[Array, "h w"]
    vv: Float[Array, "h w"]


class SubpixelPeaks(eqx.Module):
    """Peaks of a response with subpixel positions.

    Attributes:
        uv: Pixel coordinates (right, down); the pixel itself where not ok.
        ok: True where the quadratic model has its maximum within one pixel of the given one.
    """

    uv: Float[Array, "n 2"]
    ok: Bool[Array, " n"]


@filter_jit
def structure_tensor(image: Float[Array, "h w"], *, window: AbstractWindow | None = None) -> StructureTensor:
    """Averages products of the (Sobel) derivatives over a window.

    `E(d) = d^T M d` approximates the mean squared change of the window under a small displacement `d`.

    Args:
        image: Grayscale image.
        window: `Box()` (the default, 3x3) or `GaussianWindow()`.

    Returns:
        The three entries of M, each an image.

    References:
        Harris and Stephens (1988) [T-24].

    Example:
        >>> import jax.numpy as jnp
        >>> ramp = jnp.broadcast_to(2.0 * jnp.arange(7.0)[None, :], (7, 7))
        >>> tensor = structure_tensor(ramp)
        >>> float(tensor.uu[3, 3]), float(tensor.vv[3, 3])
        (4.0, 0.0)
    """
    window = Box() if window is None else window
    gradient = sobel(image)
    right, down = gradient.right, gradient.down
    return StructureTensor(window.average(right * right), window.average(right * down), window.average(down * down))


def harris(
    image: Float[Array, "h w"], *, k: float | Float[Array, ""] = 0.05, window: AbstractWindow | None = None
) -> Float[Array, "h w"]:
    """Harris's corner response `R = det M - k (tr M)^2`.

    Args:
        image: Grayscale image.
        k: Weight of the trace, 0.04 to 0.15.
        window: `Box()` (the default, 3x3) or `GaussianWindow()`.

    Returns:
        R, large at corners, negative on edges, near zero where flat; `cv2.cornerHarris` (ksize 3, float image) is 16 R.

    References:
        Harris and Stephens (1988) [T-25].

    Example:
        >>> import jax.numpy as jnp
        >>> square = jnp.zeros((16, 16)).at[4:12, 4:12].set(100.0)
        >>> response = harris(square)
        >>> bool(response[4, 4] > 0), bool(response[4, 8] < 0), float(response[8, 8])
        (True, True, 0.0)
    """
    # As an array, so that new values do not compile anew.
    return _harris(structure_tensor(image, window=window), jnp.asarray(k, image.dtype))


@filter_jit
def _harris(tensor: StructureTensor, k: Float[Array, ""]) -> Float[Array, "h w"]:
    trace = tensor.uu + tensor.vv
    return tensor.uu * tensor.vv - tensor.uv * tensor.uv - k * trace * trace


@filter_jit
def shi_tomasi(image: Float[Array, "h w"], *, window: AbstractWindow | None = None) -> Float[Array, "h w"]:
    """The smaller eigenvalue of M, `(uu + vv) / 2 - sqrt(((uu - vv) / 2)^2 + uv^2)`.

    Args:
        image: Grayscale image.
        window: `Box()` (the default, 3x3) or `GaussianWindow()`.

    Returns:
        The eigenvalue of every pixel; `cv2.cornerMinEigenVal` (ksize 3, float image) is 4 times this.

    References:
        Shi and Tomasi, "Good features to track" (1994) [T-26].

    Example:
        >>> import jax.numpy as jnp
        >>> square = jnp.zeros((16, 16)).at[4:12, 4:12].set(100.0)
        >>> response = shi_tomasi(square)
        >>> bool(response[4, 4] > 0), float(response[4, 8])
        (True, 0.0)
    """
    tensor = structure_tensor(image, window=window)
    half_difference = 0.5 * (tensor.uu - tensor.vv)
    squared = half_difference * half_difference + tensor.uv * tensor.uv
    # The root has no gradient where both eigenvalues are equal; the subgradient 0 is used there.
    apart = squared > 0
    root = jnp.where(apart, jnp.sqrt(jnp.where(apart, squared, 1.0)), 0.0)
    return 0.5 * (tensor.uu + tensor.vv) - root


def classify(response: Float[Array, "h w"], threshold: float | Float[Array, ""]) -> Int[Array, "h w"]:
    """Classifies pixels by Harris's response: 1 is a corner (`R > t`), -1 an edge (`R < -t`), 0 flat.

    References:
        The three classes of Harris and Stephens (1988) [T-25].

    Example:
        >>> import jax.numpy as jnp
        >>> classify(jnp.array([[5.0, -5.0, 0.1]]), 1.0).tolist()
        [[1, -1, 0]]
    """
    return (response > threshold).astype(jnp.int32) - (response < -threshold).astype(jnp.int32)


@filter_jit
def refine_peaks(response: Float[Array, "h w"], uv: Float[Array, "n 2"]) -> SubpixelPeaks:
    """Moves peaks to the maximum of the quadratic model of the 3x3 responses around each.

    `d = -H^-1 g` with the gradient g and the Hessian H by central differences.

    Args:
        response: A response image.
        uv: Peaks at whole pixels (rounded if not).

    Returns:
        The refined peaks; not ok on the border, at a saddle or where the maximum lies more than a pixel off.

    References:
        Brown and Lowe, "Invariant features from interest point groups" (2002).

    Example:
        >>> import jax.numpy as jnp
        >>> u, v = jnp.meshgrid(jnp.arange(7.0), jnp.arange(7.0))
        >>> response = -((u - 3.2) ** 2) - (v - 2.9) ** 2
        >>> [round(x, 3) for x in refine_peaks(response, jnp.array([[3.0, 3.0]])).uv[0].tolist()]
        [3.2, 2.9]
    """
    height, width = response.shape
    u, v = jnp.round(uv[:, 0]).astype(jnp.int32), jnp.round(uv[:, 1]).astype(jnp.int32)
    within = (u >= 1) & (u <= width - 2) & (v >= 1) & (v <= height - 2)
    u, v = jnp.where(within, u, 1), jnp.where(within, v, 1)

    def at(right: int, down: int):
        return response[v + down, u + right]

    slope_u, slope_v = 0.5 * (at(1, 0) - at(-1, 0)), 0.5 * (at(0, 1) - at(0, -1))
    uu, vv = at(1, 0) + at(-1, 0) - 2.0 * at(0, 0), at(0, 1) + at(0, -1) - 2.0 * at(0, 0)
    uv_mixed = 0.25 * (at(1, 1) + at(-1, -1) - at(1, -1) - at(-1, 1))
    determinant = uu * vv - uv_mixed * uv_mixed
    maximum = within & (uu < 0) & (determinant > 0)
    divisor = jnp.where(maximum, determinant, 1.0)
    offset = jnp.stack([uv_mixed * slope_v - vv * slope_u, uv_mixed * slope_u - uu * slope_v], axis=1)
    offset = jnp.where(maximum[:, None], offset / divisor[:, None], 0.0)
    ok = maximum & jnp.all(jnp.abs(offset) <= 1.0, axis=1)
    return SubpixelPeaks(jnp.where(ok[:, None], jnp.round(uv) + offset.astype(uv.dtype), uv), ok)
