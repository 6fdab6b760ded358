"""Whole systems: a sequence in, results out."""

from jaxloc.pipelines import datmo, laser_localization, odometry

__all__ = ["datmo", "laser_localization", "odometry"]
