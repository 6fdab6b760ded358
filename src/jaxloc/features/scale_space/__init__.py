"""Gaussian and nonlinear scale spaces, their extrema, orientations and sampling."""

from jaxloc.features.scale_space import extrema, gaussian, nonlinear, orientation, sampling
from jaxloc.features.scale_space.box_hessian import BoxHessian, box_hessian, filter_scale, filter_sizes, max_octaves
from jaxloc.features.scale_space.extrema import Extrema, ExtremumTest, find_extrema
from jaxloc.features.scale_space.gaussian import Octave, ScaleSpace, difference_of_gaussians, double, laplacian, octaves
from jaxloc.features.scale_space.nonlinear import (
    DiffusionScheme,
    FastExplicitDiffusion,
    NonlinearScaleSpace,
    OperatorSplitting,
    Stack,
    nonlinear_scale_space,
)
from jaxloc.features.scale_space.orientation import (
    DominantDirection,
    disc_offsets,
    dominant_direction,
    normalize_rows,
    rotate_gradients,
)
from jaxloc.features.scale_space.sampling import (
    KeypointLayer,
    LayerSamples,
    concatenate_layers,
    interpolate_layer,
    nearest_layer,
    oriented_grid,
)

__all__ = [
    "BoxHessian",
    "DiffusionScheme",
    "DominantDirection",
    "Extrema",
    "ExtremumTest",
    "FastExplicitDiffusion",
    "KeypointLayer",
    "LayerSamples",
    "NonlinearScaleSpace",
    "Octave",
    "OperatorSplitting",
    "ScaleSpace",
    "Stack",
    "box_hessian",
    "concatenate_layers",
    "difference_of_gaussians",
    "disc_offsets",
    "dominant_direction",
    "double",
    "extrema",
    "filter_scale",
    "filter_sizes",
    "find_extrema",
    "gaussian",
    "interpolate_layer",
    "laplacian",
    "max_octaves",
    "nearest_layer",
    "nonlinear",
    "nonlinear_scale_space",
    "normalize_rows",
    "octaves",
    "orientation",
    "oriented_grid",
    "rotate_gradients",
    "sampling",
]
