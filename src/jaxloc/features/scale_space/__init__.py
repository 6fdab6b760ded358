"""Gaussian and nonlinear scale spaces, their extrema and orientations."""

from jaxloc.features.scale_space import extrema, gaussian, nonlinear, orientation
from jaxloc.features.scale_space.box_hessian import BoxHessian, box_hessian, filter_sizes, octaves_that_fit, scale_of
from jaxloc.features.scale_space.extrema import Extrema, ExtremumTest, find_extrema
from jaxloc.features.scale_space.gaussian import Octave, ScaleSpace, difference_of_gaussians, double, laplacian, octaves
from jaxloc.features.scale_space.nonlinear import (
    DiffusedScaleSpace,
    ExplicitCycle,
    Samples,
    Scheme,
    Seat,
    Splitting,
    Stack,
    read,
    samples_of,
    seat_of,
    stacks,
)
from jaxloc.features.scale_space.orientation import DominantDirection, disc, dominant_direction, turned, unit_rows

__all__ = [
    "BoxHessian",
    "DiffusedScaleSpace",
    "DominantDirection",
    "ExplicitCycle",
    "Extrema",
    "ExtremumTest",
    "Octave",
    "Samples",
    "ScaleSpace",
    "Scheme",
    "Seat",
    "Splitting",
    "Stack",
    "box_hessian",
    "difference_of_gaussians",
    "disc",
    "dominant_direction",
    "double",
    "extrema",
    "filter_sizes",
    "find_extrema",
    "gaussian",
    "laplacian",
    "nonlinear",
    "octaves",
    "octaves_that_fit",
    "orientation",
    "read",
    "samples_of",
    "scale_of",
    "seat_of",
    "stacks",
    "turned",
    "unit_rows",
]
