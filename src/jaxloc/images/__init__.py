"""Image processing in JAX: interpolation, gradients, pyramids, warps, normalization, nonlinear diffusion."""

from jaxloc.images import (
    diffusion,
    gradients,
    integral,
    interpolation,
    normalization,
    patches,
    pyramid,
    spectrum,
    warps,
)
from jaxloc.images.interpolation import Bicubic, Bilinear
from jaxloc.images.warps import Affine, Euclidean, Homography, Similarity, Translation, Warp

__all__ = [
    "Affine",
    "Bicubic",
    "Bilinear",
    "Euclidean",
    "Homography",
    "Similarity",
    "Translation",
    "Warp",
    "diffusion",
    "gradients",
    "integral",
    "interpolation",
    "normalization",
    "patches",
    "pyramid",
    "spectrum",
    "warps",
]
