"""Stereo visual odometry: feature matching, motion estimation, scene flow and moving objects."""

from jaxloc.odometry import moving_objects, scene_flow, stereo_matching, visual_odometry
from jaxloc.odometry.moving_objects import GroupOptions, MovingObjects, group_points
from jaxloc.odometry.scene_flow import FlowOptions, MovingPoints, find_moving
from jaxloc.odometry.stereo_matching import MatchingOptions, StereoFeatures, match_frames, match_stereo
from jaxloc.odometry.visual_odometry import MotionOptions, estimate_disparity_offset, estimate_motion

__all__ = [
    "FlowOptions",
    "GroupOptions",
    "MatchingOptions",
    "MotionOptions",
    "MovingObjects",
    "MovingPoints",
    "StereoFeatures",
    "estimate_disparity_offset",
    "estimate_motion",
    "find_moving",
    "group_points",
    "match_frames",
    "match_stereo",
    "moving_objects",
    "scene_flow",
    "stereo_matching",
    "visual_odometry",
]
