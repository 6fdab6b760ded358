"""Features to pose: residuals of what a camera sees, and the poses that explain it best."""

from jaxloc.refinement import (
    association,
    bundle,
    calibration,
    correspondences,
    image_velocity,
    pallet,
    reprojection,
    resection,
)
from jaxloc.refinement.reprojection import Reprojection, StereoReprojection
from jaxloc.refinement.resection import StereoMatches, motion_problem, refine_motion, refine_pose

__all__ = [
    "Reprojection",
    "StereoMatches",
    "StereoReprojection",
    "association",
    "bundle",
    "calibration",
    "correspondences",
    "image_velocity",
    "motion_problem",
    "pallet",
    "refine_motion",
    "refine_pose",
    "reprojection",
    "resection",
]
