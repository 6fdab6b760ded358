"""Blobs over scale: Gaussian scale space, its extrema, and SIFT, in JAX."""

from jaxloc.images.blobs import extrema, scale_space
from jaxloc.images.blobs.extrema import ExtremumTest, find_extrema
from jaxloc.images.blobs.scale_space import ScaleSpace, difference_of_gaussians, laplacian, octaves
from jaxloc.images.blobs.sift import Sift, describe_sift, sift

__all__ = [
    "ExtremumTest",
    "ScaleSpace",
    "Sift",
    "describe_sift",
    "difference_of_gaussians",
    "extrema",
    "find_extrema",
    "laplacian",
    "octaves",
    "scale_space",
    "sift",
]
