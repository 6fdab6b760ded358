"""Whole systems: a sequence in, results out."""

from jaxloc.pipelines import (
    calibration,
    datmo,
    detection_models,
    detection_options,
    detection_tracking,
    floor_mosaic,
    floor_path,
    lane_following,
    lane_pitch,
    lane_tracker,
    laser_localization,
    odometry,
)

__all__ = [
    "calibration",
    "datmo",
    "detection_models",
    "detection_options",
    "detection_tracking",
    "floor_mosaic",
    "floor_path",
    "lane_following",
    "lane_pitch",
    "lane_tracker",
    "laser_localization",
    "odometry",
]
