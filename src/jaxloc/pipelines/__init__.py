"""Whole systems: a sequence in, results out."""

from jaxloc.pipelines import odometry

__all__ = ["odometry"]
