"""Blobs over scale: Gaussian scale space, its extrema, SIFT, and SURF by box filters, in JAX."""

from jaxloc.images.blobs import box_hessian, directions, extrema, scale_space
from jaxloc.images.blobs.box_hessian import BoxHessian
from jaxloc.images.blobs.directions import dominant_direction
from jaxloc.images.blobs.extrema import ExtremumTest, find_extrema
from jaxloc.images.blobs.scale_space import ScaleSpace, difference_of_gaussians, laplacian, octaves
from jaxloc.images.blobs.sift import Sift, describe_sift, sift
from jaxloc.images.blobs.surf import Surf, describe_surf, laplacian_gate, surf

__all__ = [
    "BoxHessian",
    "ExtremumTest",
    "ScaleSpace",
    "Sift",
    "Surf",
    "box_hessian",
    "describe_sift",
    "describe_surf",
    "difference_of_gaussians",
    "directions",
    "dominant_direction",
    "extrema",
    "find_extrema",
    "laplacian",
    "laplacian_gate",
    "octaves",
    "scale_space",
    "sift",
    "surf",
]
