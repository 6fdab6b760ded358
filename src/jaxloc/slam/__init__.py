"""Simultaneous localization and mapping: EKF-SLAM, FastSLAM, pose graphs and mosaics."""

from jaxloc.slam import ekf_slam, fast_slam, mosaic, pose_graph
from jaxloc.slam.ekf_slam import EkfSlam, SlamInfo, SlamState
from jaxloc.slam.fast_slam import Appearance, DescriptorFastSlam, FastSlam, FastSlamInfo, FastSlamState

__all__ = [
    "Appearance",
    "DescriptorFastSlam",
    "EkfSlam",
    "FastSlam",
    "FastSlamInfo",
    "FastSlamState",
    "SlamInfo",
    "SlamState",
    "ekf_slam",
    "fast_slam",
    "mosaic",
    "pose_graph",
]
