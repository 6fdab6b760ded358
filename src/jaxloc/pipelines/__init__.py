"""Complete systems over recordings or live input.

`state = init(config, ...)` and `state, output = step(state, input)` are the verbs of every pipeline;
`run(source, config, ...)` yields the output of each step; `checkpoint` saves a state and restores it.
"""

from jaxloc.pipelines import (
    calibration,
    checkpoint,
    detection_tracking,
    floor_mosaic,
    lane_following,
    localization,
    moving_objects,
    odometry,
)

__all__ = [
    "calibration",
    "checkpoint",
    "detection_tracking",
    "floor_mosaic",
    "lane_following",
    "localization",
    "moving_objects",
    "odometry",
]
