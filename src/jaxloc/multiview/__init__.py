"""Closed-form geometry of several views."""

from jaxloc.multiview import (
    disparity,
    epipolar,
    five_point,
    fundamental_matrix,
    homography,
    planar_motion,
    rectification,
    stereo_triangulation,
    triangulation,
    two_view,
    upright,
)
from jaxloc.multiview.epipolar import RelativePose
from jaxloc.multiview.homography import estimate_homography
from jaxloc.multiview.p3p import MinimalPoses, p3p
from jaxloc.multiview.stereo_triangulation import Linear, Sampled, TriangulationMethod, Unscented, coverage
from jaxloc.multiview.two_view import ConsensusOptions, estimate_relative_pose

__all__ = [
    "ConsensusOptions",
    "Linear",
    "MinimalPoses",
    "RelativePose",
    "Sampled",
    "TriangulationMethod",
    "Unscented",
    "coverage",
    "disparity",
    "epipolar",
    "estimate_homography",
    "estimate_relative_pose",
    "five_point",
    "fundamental_matrix",
    "homography",
    "p3p",
    "planar_motion",
    "rectification",
    "stereo_triangulation",
    "triangulation",
    "two_view",
    "upright",
]
