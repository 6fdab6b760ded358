"""Closed-form geometry of several views."""

from jaxloc.multiview import minimal, rectification, triangulation
from jaxloc.multiview.minimal import MinimalPoses, p3p
from jaxloc.multiview.triangulation import Linear, Sampled, TriangulationMethod, Unscented, coverage, stereo

__all__ = [
    "Linear",
    "MinimalPoses",
    "Sampled",
    "TriangulationMethod",
    "Unscented",
    "coverage",
    "minimal",
    "p3p",
    "rectification",
    "stereo",
    "triangulation",
]
