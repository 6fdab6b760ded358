"""Trajectories and maps."""

from jaxloc.slam import ekf_slam, stereo_matching, visual_odometry
from jaxloc.slam.ekf_slam import EkfSlam, SlamInfo, SlamState
from jaxloc.slam.stereo_matching import MatchingOptions, StereoFeatures, match_frames, match_stereo
from jaxloc.slam.visual_odometry import CameraMotion, MotionOptions, estimate_disparity_offset, estimate_motion

__all__ = [
    "CameraMotion",
    "EkfSlam",
    "MatchingOptions",
    "MotionOptions",
    "SlamInfo",
    "SlamState",
    "StereoFeatures",
    "ekf_slam",
    "estimate_disparity_offset",
    "estimate_motion",
    "match_frames",
    "match_stereo",
    "stereo_matching",
    "visual_odometry",
]
