"""Whole systems: a sequence in, results out."""

from jaxloc.pipelines import laser_localization, odometry

__all__ = ["laser_localization", "odometry"]
