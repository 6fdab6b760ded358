"""Closed-form geometry of several views."""

from jaxloc.multiview import (
    disparity,
    epipolar,
    five_point,
    fundamental,
    homography,
    intersection,
    minimal,
    planar_motion,
    rectification,
    triangulation,
    two_view,
    upright,
)
from jaxloc.multiview.epipolar import RelativePose
from jaxloc.multiview.homography import estimate_homography
from jaxloc.multiview.intersection import intersect
from jaxloc.multiview.minimal import MinimalPoses, p3p
from jaxloc.multiview.triangulation import Linear, Sampled, TriangulationMethod, Unscented, coverage, stereo
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
    "fundamental",
    "homography",
    "intersect",
    "intersection",
    "minimal",
    "p3p",
    "planar_motion",
    "rectification",
    "stereo",
    "triangulation",
    "two_view",
    "upright",
]
