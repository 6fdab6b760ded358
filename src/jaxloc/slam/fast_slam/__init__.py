"""FastSLAM: a Rao-Blackwellized particle filter over the path, with a Kalman filter per landmark.

Given the path, landmarks are independent of each other (Rao-Blackwell), so that a particle needs a 2x2 covariance for
each instead of one over all: the cost is linear in landmarks, not quadratic, and each particle decides by itself which
landmark a reading belongs to.

References:
    Montemerlo et al., "FastSLAM", AAAI 2002, and "FastSLAM 2.0", IJCAI 2003; Murphy and Russell, "Rao-Blackwellised
    particle filtering", 2001; review section 3.3 [R-15...R-21].
"""

from jaxloc.slam.fast_slam.association import Association, Candidates, associate
from jaxloc.slam.fast_slam.block_proposal import BlockProposal
from jaxloc.slam.fast_slam.descriptors import Appearance, Appearances, DescriptorFastSlam, DescriptorSlamState
from jaxloc.slam.fast_slam.fast_slam import FastSlam, FastSlamInfo, trace_back
from jaxloc.slam.fast_slam.landmark_filter import LandmarkFilter, Landmarks
from jaxloc.slam.fast_slam.proposals import MeasurementProposal, MotionProposal, PathProposal
from jaxloc.slam.fast_slam.state import FastSlamState

__all__ = [
    "Appearance",
    "Appearances",
    "Association",
    "Candidates",
    "DescriptorFastSlam",
    "DescriptorSlamState",
    "FastSlam",
    "FastSlamInfo",
    "FastSlamState",
    "BlockProposal",
    "MotionProposal",
    "MeasurementProposal",
    "LandmarkFilter",
    "Landmarks",
    "PathProposal",
    "associate",
    "trace_back",
]
