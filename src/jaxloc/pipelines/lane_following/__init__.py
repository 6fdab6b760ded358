"""Lane following: lateral position and heading of a vehicle in its lane, image by image."""

from jaxloc.pipelines.lane_following import following, lane_tracker, pitch
from jaxloc.pipelines.lane_following.following import Config, Frame, Output, State, correct_pitch, init, run, step
from jaxloc.pipelines.lane_following.lane_tracker import (
    FitSensor,
    LaneTracker,
    Update,
    adapt_template,
    border_columns,
    detect_by_template,
    detect_lane,
    initial_state,
    painted_templates,
    predict,
    update_by_borders,
    update_by_template,
)
from jaxloc.pipelines.lane_following.pitch import Pitch, estimate_pitch

__all__ = [
    "Config",
    "FitSensor",
    "Frame",
    "LaneTracker",
    "Output",
    "Pitch",
    "State",
    "Update",
    "adapt_template",
    "border_columns",
    "correct_pitch",
    "detect_by_template",
    "detect_lane",
    "estimate_pitch",
    "following",
    "init",
    "initial_state",
    "lane_tracker",
    "painted_templates",
    "pitch",
    "predict",
    "run",
    "step",
    "update_by_borders",
    "update_by_template",
]
