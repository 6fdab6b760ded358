"""Floor mosaics: registration and blending of downward images, and camera tracking in the mosaic."""

from jaxloc.slam.mosaic.blend import Exposure, balance, blend, enclose
from jaxloc.slam.mosaic.features import FeaturePairs, Squares, feature_jacobian, pose_from_features, register_squares
from jaxloc.slam.mosaic.raster import Raster
from jaxloc.slam.mosaic.register import PAIRWISE, Overlap, Registration, register
from jaxloc.slam.mosaic.tracking import TRACKING, track
from jaxloc.slam.mosaic.view import CosineFourth, Falloff, FloorView, Patch, RadialFalloff, Rectifier, fit_falloff

__all__ = [
    "PAIRWISE",
    "TRACKING",
    "CosineFourth",
    "Exposure",
    "Falloff",
    "FeaturePairs",
    "FloorView",
    "Overlap",
    "Patch",
    "RadialFalloff",
    "Raster",
    "Rectifier",
    "Registration",
    "Squares",
    "balance",
    "blend",
    "enclose",
    "feature_jacobian",
    "fit_falloff",
    "pose_from_features",
    "register",
    "register_squares",
    "track",
]
