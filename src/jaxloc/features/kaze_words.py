"""Descriptors of KAZE and A-KAZE: M-SURF, 64 numbers, and M-LDB, 486 bits."""

from abc import abstractmethod

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxloc.features.scale_space.orientation import turned, unit_rows

# M-SURF: cells along a side, samples along a cell and between two cells; deviations of the Gaussians (samples, cells).
_CELLS, _CELL, _SHIFT, _NARROW, _WIDE = 4, 9, 5, 2.5, 1.5
# M-LDB: samples along a side, and cells along a side of each grid.
_SIDE, _GRIDS = 20, (2, 3, 4)


class Words(eqx.Module):
    """How the samples around a keypoint become a descriptor."""

    side: eqx.AbstractClassVar[int]

    @abstractmethod
    def of(self, values: Float[Array, "n k 3"], inside: Bool[Array, "n k"], angle: Float[Array, " n"]) -> Array:
        """Descriptors of gray levels and derivatives on a grid of ``side x side``, turned with the keypoint.

        Args:
            values: gray level, derivative along rows and along columns of the image.
            inside: which samples lie inside of the image.
            angle: of the keypoint, rad.
        """


class MSurf(Words):
    """Sums of derivatives and of their absolute values in 4 x 4 cells that overlap: 64 numbers of length one.

    Samples of a cell are weighted by a Gaussian about the cell's middle, cells by one about the keypoint.

    References:
        Agrawal, Konolige, Blas, "CenSurE", ECCV 2008; Alcantarilla et al., ECCV 2012, section 3.2.
    """

    side = _SHIFT * (_CELLS - 1) + _CELL

    def of(self, values: Float[Array, "n k 3"], inside: Bool[Array, "n k"], angle: Float[Array, " n"]) -> Array:
        """64 numbers."""
        derivatives = jnp.where(inside[:, :, None], values[:, :, 1:], 0.0)
        along, aside = turned(derivatives[:, :, 0], derivatives[:, :, 1], angle)
        cells = jnp.asarray(self.shares(), values.dtype)
        sums = [part @ cells for part in (along, aside, jnp.abs(along), jnp.abs(aside))]
        return unit_rows(jnp.stack(sums, axis=2).reshape(len(angle), -1))

    def shares(self) -> np.ndarray:
        """Weights of all samples in all cells.

        Example:
            >>> MSurf().shares().shape
            (576, 16)
        """
        sample, cell = np.arange(self.side)[:, None], np.arange(_CELLS)[None, :]
        apart = sample - (_SHIFT * cell + 0.5 * (_CELL - 1))
        share = np.where(2 * np.abs(apart) < _CELL, np.exp(-0.5 * (apart / _NARROW) ** 2), 0.0)
        share = share * np.exp(-0.5 * ((cell - 0.5 * (_CELLS - 1)) / _WIDE) ** 2)
        return np.kron(share, share)


class MLdb(Words):
    """Comparisons of mean gray level and mean derivatives of all pairs of cells of three grids: 486 bits in 61 bytes.

    ``(6 + 36 + 120) pairs x 3 channels``; cells whose border cuts a sample share it.

    References:
        Yang and Cheng, "LDB", ISMAR 2012; Alcantarilla et al., BMVC 2013, section 3.3 [T-50].
    """

    side = _SIDE

    def of(self, values: Float[Array, "n k 3"], inside: Bool[Array, "n k"], angle: Float[Array, " n"]) -> Array:
        """61 bytes, the first bit in the lowest place, the last two bits zero."""
        bits = self.bits(values, angle)
        return jnp.packbits(bits, axis=1, bitorder="little")

    def bits(self, values: Float[Array, "n k 3"], angle: Float[Array, " n"]) -> Bool[Array, "n 486"]:
        """The bits one by one."""
        along, aside = turned(values[:, :, 1], values[:, :, 2], angle)
        channels = jnp.stack([values[:, :, 0], along, aside], axis=1)
        parts = []
        for cells in _GRIDS:
            means = channels @ jnp.asarray(self.shares(cells), values.dtype)
            first, second = np.triu_indices(cells * cells, 1)
            parts.append((means[:, :, first] > means[:, :, second]).reshape(len(angle), -1))
        return jnp.concatenate(parts, axis=1)

    def shares(self, cells: int) -> np.ndarray:
        """Weights of all samples in the means of all cells of a grid.

        Example:
            >>> [MLdb().shares(cells).shape for cells in (2, 3, 4)]
            [(400, 4), (400, 9), (400, 16)]
        """
        edge = _SIDE / cells * np.arange(cells + 1)
        sample = np.arange(_SIDE)[:, None]
        share = np.minimum(sample + 1, edge[None, 1:]) - np.maximum(sample, edge[None, :-1])
        share = np.maximum(share, 0.0) * cells / _SIDE
        return np.kron(share, share)
