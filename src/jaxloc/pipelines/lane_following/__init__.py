"""Lane following: the position of a vehicle in its lane, image by image."""

from jaxloc.pipelines.lane_following import following, pitch, tracker
from jaxloc.pipelines.lane_following.following import Config, Frame, LaneFollower, Step, follow, level
from jaxloc.pipelines.lane_following.pitch import Pitch, estimate_pitch
from jaxloc.pipelines.lane_following.tracker import (
    FitSensor,
    Moved,
    Tracker,
    adapt,
    begin,
    border_columns,
    follow_template,
    painted_bank,
    predict,
    recognize,
    settle,
    unknown_state,
)

__all__ = [
    "Config",
    "FitSensor",
    "Frame",
    "LaneFollower",
    "Moved",
    "Pitch",
    "Step",
    "Tracker",
    "adapt",
    "begin",
    "border_columns",
    "estimate_pitch",
    "follow",
    "follow_template",
    "following",
    "level",
    "painted_bank",
    "pitch",
    "predict",
    "recognize",
    "settle",
    "tracker",
    "unknown_state",
]
