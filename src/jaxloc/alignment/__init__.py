"""Direct image alignment and point tracking: Lucas-Kanade, KLT, ECC, correlation, mutual information."""

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
