"""Closed-form geometry of several views."""

from jaxloc.multiview import disparity, homography, intersection, minimal, rectification, triangulation
from jaxloc.multiview.homography import estimate_homography
from jaxloc.multiview.intersection import intersect
from jaxloc.multiview.minimal import MinimalPoses, p3p
from jaxloc.multiview.triangulation import Linear, Sampled, TriangulationMethod, Unscented, coverage, stereo

__all__ = [
    "Linear",
    "MinimalPoses",
    "Sampled",
    "TriangulationMethod",
    "Unscented",
    "coverage",
    "disparity",
    "estimate_homography",
    "homography",
    "intersect",
    "intersection",
    "minimal",
    "p3p",
    "rectification",
    "stereo",
    "triangulation",
]
