"""Detection and tracking of moving objects from a moving stereo camera."""

from jaxloc.pipelines.moving_objects import object_filter, options, tracking
from jaxloc.pipelines.moving_objects.object_filter import ObjectBirth, build_tracker, update_filter
from jaxloc.pipelines.moving_objects.options import Config
from jaxloc.pipelines.moving_objects.tracking import (
    Confirmations,
    Output,
    State,
    Track,
    init,
    run,
    run_after_odometry,
    step,
    update_tracks,
)

__all__ = [
    "Config",
    "Confirmations",
    "ObjectBirth",
    "Output",
    "State",
    "Track",
    "build_tracker",
    "init",
    "object_filter",
    "options",
    "run",
    "run_after_odometry",
    "step",
    "tracking",
    "update_filter",
    "update_tracks",
]
