"""Mosaics of floors, and localization in them."""

from jaxloc.pipelines.floor_mosaic import mosaic, path
from jaxloc.pipelines.floor_mosaic.mosaic import (
    FloorMosaic,
    Tracked,
    localize,
    make_mosaic,
    make_view,
    tracking_rectifier,
)
from jaxloc.pipelines.floor_mosaic.path import (
    Config,
    OdometryNoise,
    Pair,
    PathBuilder,
    odometry_covariances,
    planar,
    pose_of_row,
    row_of_pose,
)

__all__ = [
    "Config",
    "FloorMosaic",
    "OdometryNoise",
    "Pair",
    "PathBuilder",
    "Tracked",
    "localize",
    "make_mosaic",
    "make_view",
    "mosaic",
    "odometry_covariances",
    "path",
    "planar",
    "pose_of_row",
    "row_of_pose",
    "tracking_rectifier",
]
