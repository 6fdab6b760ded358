"""Signals to pose: pictures laid upon each other."""

from jaxloc.alignment import (
    correlation,
    departure,
    dickmanns,
    ecc,
    ground_view,
    lucas_kanade,
    mosaic,
    multi_start,
    mutual_information,
    phase,
    plane_pose,
    ralph,
    tracker,
)

__all__ = [
    "correlation",
    "departure",
    "dickmanns",
    "ecc",
    "ground_view",
    "lucas_kanade",
    "mosaic",
    "multi_start",
    "mutual_information",
    "phase",
    "plane_pose",
    "ralph",
    "tracker",
]
