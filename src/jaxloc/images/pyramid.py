"""Gaussian image pyramids; a pixel `uv` of level `k` is the pixel `uv * 2**k` of the image."""

from jaxtyping import Array, Float

from jaxloc._jit import filter_jit
from jaxloc._xla import compute_once
from jaxloc.images.gradients import pad_reflected

_BINOMIAL = (1.0 / 16.0, 4.0 / 16.0, 6.0 / 16.0, 4.0 / 16.0, 1.0 / 16.0)


@filter_jit
def halve(image: Float[Array, "h w"]) -> Float[Array, "h2 w2"]:
    """Smooths with the binomial kernel (1, 4, 6, 4, 1) / 16 and keeps every second row and column, as `cv2.pyrDown`.

    The kept pixels are the even ones, so that pixel `uv` becomes `uv / 2`.

    Args:
        image: Grayscale image.

    Returns:
        An image of `ceil(h / 2)` rows and `ceil(w / 2)` columns.

    References:
        Burt and Adelson, "The Laplacian pyramid as a compact image code" (1983).

    Example:
        >>> import jax.numpy as jnp
        >>> halve(jnp.ones((7, 10))).shape
        (4, 5)
    """
    return compute_once(_halve_columns, compute_once(_halve_rows, image))


@filter_jit
def gaussian_pyramid(image: Float[Array, "h w"], *, levels: int) -> tuple[Float[Array, "_ _"], ...]:
    """Builds the image at full, half, quarter, ... size.

    Args:
        image: Grayscale image.
        levels: Static number of levels, the full image included.

    Returns:
        The levels, finest first.

    Raises:
        ValueError: There are fewer than one level, or the coarsest would have fewer than three rows or columns.

    References:
        Burt and Adelson (1983).

    Example:
        >>> import jax.numpy as jnp
        >>> [level.shape for level in gaussian_pyramid(jnp.ones((20, 31)), levels=3)]
        [(20, 31), (10, 16), (5, 8)]
    """
    if levels < 1 or (levels > 1 and min(image.shape) <= 2**levels):
        raise ValueError(
            f"gaussian_pyramid: {levels} levels do not fit an image of shape {image.shape}; ask for fewer."
        )
    pyramid = [image]
    for _ in range(levels - 1):
        pyramid.append(halve(pyramid[-1]))
    return tuple(pyramid)


def to_level(uv: Float[Array, "n 2"], level: int) -> Float[Array, "n 2"]:
    """Pixel coordinates of the image as coordinates of a pyramid level: `uv / 2**level`.

    Example:
        >>> import jax.numpy as jnp
        >>> to_level(jnp.array([[8.0, 6.0]]), 1).tolist()
        [[4.0, 3.0]]
    """
    return uv * 0.5**level


def from_level(uv: Float[Array, "n 2"], level: int) -> Float[Array, "n 2"]:
    """Pixel coordinates of a pyramid level as coordinates of the image: `uv * 2**level`.

    Example:
        >>> import jax.numpy as jnp
        >>> from_level(jnp.array([[4.0, 3.0]]), 1).tolist()
        [[8.0, 6.0]]
    """
    return uv * 2.0**level


def _halve_rows(image: Float[Array, "h w"]) -> Float[Array, "h2 w"]:
    padded = pad_reflected(image, (2, 0))
    return sum(weight * padded[k : k + image.shape[0] : 2] for k, weight in enumerate(_BINOMIAL))


def _halve_columns(image: Float[Array, "h w"]) -> Float[Array, "h w2"]:
    padded = pad_reflected(image, (0, 2))
    return sum(weight * padded[:, k : k + image.shape[1] : 2] for k, weight in enumerate(_BINOMIAL))
