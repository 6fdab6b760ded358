"""Signals to pose: pictures laid upon each other."""

from jaxloc.alignment import (
    correlation,
    ecc,
    lucas_kanade,
    multi_start,
    mutual_information,
    phase,
    plane_pose,
    tracker,
)

__all__ = [
    "correlation",
    "ecc",
    "lucas_kanade",
    "multi_start",
    "mutual_information",
    "phase",
    "plane_pose",
    "tracker",
]
