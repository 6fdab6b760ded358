"""Mosaics of floors, and localization in them."""

from jaxloc.pipelines.floor_mosaic import localization, mosaic, options, registration
from jaxloc.pipelines.floor_mosaic.localization import tracking_rectifier
from jaxloc.pipelines.floor_mosaic.mosaic import (
    FloorMosaic,
    Frame,
    Output,
    State,
    finish,
    init,
    make_mosaic,
    make_view,
    run,
    split_frames,
    step,
)
from jaxloc.pipelines.floor_mosaic.options import Config, OdometryNoise
from jaxloc.pipelines.floor_mosaic.registration import (
    Pair,
    Path,
    odometry_covariances,
    planar,
    pose_of_row,
    row_of_pose,
)

__all__ = [
    "Config",
    "FloorMosaic",
    "Frame",
    "OdometryNoise",
    "Output",
    "Pair",
    "Path",
    "State",
    "finish",
    "init",
    "localization",
    "make_mosaic",
    "make_view",
    "mosaic",
    "odometry_covariances",
    "options",
    "planar",
    "pose_of_row",
    "registration",
    "row_of_pose",
    "run",
    "split_frames",
    "step",
    "tracking_rectifier",
]
