"""Trajectories and maps."""

from jaxloc.slam import stereo_matching, visual_odometry
from jaxloc.slam.stereo_matching import MatchingOptions, StereoFeatures, match_frames, match_stereo
from jaxloc.slam.visual_odometry import Motion, MotionOptions, estimate_disparity_offset, estimate_motion

__all__ = [
    "MatchingOptions",
    "Motion",
    "MotionOptions",
    "StereoFeatures",
    "estimate_disparity_offset",
    "estimate_motion",
    "match_frames",
    "match_stereo",
    "stereo_matching",
    "visual_odometry",
]
