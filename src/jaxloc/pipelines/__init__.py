"""Complete systems: recordings in, results out."""

from jaxloc.pipelines import (
    calibration,
    detection_tracking,
    floor_mosaic,
    lane_following,
    localization,
    moving_objects,
    odometry,
)

__all__ = [
    "calibration",
    "detection_tracking",
    "floor_mosaic",
    "lane_following",
    "localization",
    "moving_objects",
    "odometry",
]
