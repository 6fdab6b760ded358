"""Whole systems: a sequence in, results out."""

from jaxloc.pipelines import (
    datmo,
    detection_models,
    detection_options,
    detection_tracking,
    laser_localization,
    odometry,
)

__all__ = ["datmo", "detection_models", "detection_options", "detection_tracking", "laser_localization", "odometry"]
