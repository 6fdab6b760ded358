"""A-KAZE features: blobs of a nonlinear scale space by fast explicit diffusion and M-LDB descriptors, in JAX.

References:
    Alcantarilla, Nuevo, Bartoli, "Fast explicit diffusion for accelerated features in nonlinear scale spaces", BMVC
    2013.
"""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxloc.features.kaze import AbstractDescriptor, Kaze, describe_kaze, kaze
from jaxloc.features.keypoints import Descriptors, Keypoints
from jaxloc.features.scale_space.nonlinear import NonlinearScaleSpace
from jaxloc.features.scale_space.orientation import rotate_gradients

# M-LDB: samples along a side, and cells along a side of each grid.
_SIDE, _GRIDS = 20, (2, 3, 4)


class MLdb(AbstractDescriptor):
    """M-LDB descriptor: comparisons of the means of all pairs of cells of three grids, 486 bits in 61 bytes.

    ``(6 + 36 + 120) pairs x 3 channels`` (gray level and both derivatives); samples on a border of cells are shared.

    References:
        Yang and Cheng, "LDB", ISMAR 2012; Alcantarilla et al., BMVC 2013, section 3.3 [T-50].
    """

    side = _SIDE

    def describe(self, values: Float[Array, "n k 3"], inside: Bool[Array, "n k"], angle: Float[Array, " n"]) -> Array:
        """Descriptors "n 61" of packed bits, the first in the lowest place; the last two bits are zero."""
        bits = self.bits(values, angle)
        return jnp.packbits(bits, axis=1, bitorder="little")

    def bits(self, values: Float[Array, "n k 3"], angle: Float[Array, " n"]) -> Bool[Array, "n 486"]:
        """The bits before packing."""
        along, across = rotate_gradients(values[:, :, 1], values[:, :, 2], angle)
        channels = jnp.stack([values[:, :, 0], along, across], axis=1)
        parts = []
        for cells in _GRIDS:
            means = channels @ jnp.asarray(self.cell_weights(cells), values.dtype)
            first, second = np.triu_indices(cells * cells, 1)
            parts.append((means[:, :, first] > means[:, :, second]).reshape(len(angle), -1))
        return jnp.concatenate(parts, axis=1)

    def cell_weights(self, cells: int) -> np.ndarray:
        """Weights of all samples in the means of all cells of a grid.

        Example:
            >>> [MLdb().cell_weights(cells).shape for cells in (2, 3, 4)]
            [(400, 4), (400, 9), (400, 16)]
        """
        edge = _SIDE / cells * np.arange(cells + 1)
        sample = np.arange(_SIDE)[:, None]
        share = np.minimum(sample + 1, edge[None, 1:]) - np.maximum(sample, edge[None, :-1])
        share = np.maximum(share, 0.0) * cells / _SIDE
        return np.kron(share, share)


def akaze_options(octaves: int = 4, *, least_response: float = 1e-3, upright: bool = False) -> Kaze:
    """Options of A-KAZE: octaves of halved resolution, fast explicit diffusion, binary descriptors.

    Args:
        octaves: greatest number of octaves.
        least_response: threshold of the determinant, as a fraction of 255^2.
        upright: orientation zero for all keypoints: for cameras that do not roll.

    Example:
        >>> akaze_options().descriptor.side
        20
    """
    scales = NonlinearScaleSpace.akaze(octaves)
    return Kaze(scales, MLdb(), within_layer=True, least_response=least_response, upright=upright)


_DEFAULT = akaze_options()


def akaze(
    image: Float[Array, "h w"], *, options: Kaze = _DEFAULT, capacity: int = 1000
) -> tuple[Keypoints, Descriptors]:
    """A-KAZE keypoints with scale and orientation, and their descriptors.

    Args:
        image: gray levels 0-255.
        options: from `akaze_options`.
        capacity: greatest number of keypoints, the strongest first.

    Returns:
        Keypoints (``size`` is three blurs, as in OpenCV) and 486 bits each, packed into 61 bytes.

    References:
        Alcantarilla et al. 2013 [T-43, T-49, T-50].

    Example:
        >>> import jax.numpy as jnp
        >>> u, v = jnp.meshgrid(jnp.arange(64.0), jnp.arange(64.0))
        >>> image = 60 + 120 * jnp.exp(-((u - 30.3) ** 2 + 1.3 * (v - 33.6) ** 2) / 18)
        >>> keypoints, descriptors = akaze(image, capacity=4)
        >>> [round(float(x)) for x in keypoints.uv[0]], descriptors.values.shape
        ([30, 34], (4, 61))
    """
    keypoints, descriptors = kaze(image, options=options, capacity=capacity)
    return replace(keypoints, detector="akaze"), descriptors


def describe_akaze(image: Float[Array, "h w"], keypoints: Keypoints, *, options: Kaze = _DEFAULT) -> Descriptors:
    """A-KAZE descriptors of given keypoints with size and orientation.

    Args:
        image: gray levels 0-255.
        keypoints: ``size`` is twice the reach of the derivatives.
        options: from `akaze_options`.

    Returns:
        61 bytes a keypoint; zero where not valid.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> image = jax.random.uniform(jax.random.key(0), (64, 64), maxval=255.0)
        >>> points = Keypoints.from_uv(jnp.array([[30.0, 30.0]]), size=6.0)
        >>> describe_akaze(image, points).values.dtype
        dtype('uint8')
    """
    return describe_kaze(image, keypoints, options=options)
