"""Image alignment and point tracking from gray levels."""

from jaxloc.alignment import (
    correlation,
    ecc,
    klt,
    lucas_kanade,
    multi_start,
    mutual_information,
    phase_correlation,
    plane_pose,
)

__all__ = [
    "correlation",
    "ecc",
    "klt",
    "lucas_kanade",
    "multi_start",
    "mutual_information",
    "phase_correlation",
    "plane_pose",
]
