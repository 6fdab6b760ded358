"""Trajectories and maps."""

from jaxloc.slam import ekf_slam, moving_objects, pose_graph, scene_flow, stereo_matching, visual_odometry
from jaxloc.slam.ekf_slam import EkfSlam, SlamInfo, SlamState
from jaxloc.slam.moving_objects import GroupOptions, MovingObjects, group_points
from jaxloc.slam.scene_flow import FlowOptions, MovingPoints, find_moving
from jaxloc.slam.stereo_matching import MatchingOptions, StereoFeatures, match_frames, match_stereo
from jaxloc.slam.visual_odometry import CameraMotion, MotionOptions, estimate_disparity_offset, estimate_motion

__all__ = [
    "CameraMotion",
    "EkfSlam",
    "FlowOptions",
    "GroupOptions",
    "MatchingOptions",
    "MotionOptions",
    "MovingObjects",
    "MovingPoints",
    "SlamInfo",
    "SlamState",
    "StereoFeatures",
    "ekf_slam",
    "estimate_disparity_offset",
    "estimate_motion",
    "find_moving",
    "group_points",
    "match_frames",
    "match_stereo",
    "moving_objects",
    "pose_graph",
    "scene_flow",
    "stereo_matching",
    "visual_odometry",
]
