"""Poses from features by nonlinear least squares: PnP, stereo motion, calibration, bundle adjustment."""

from jaxloc.refinement import (
    association,
    attributes,
    bundle,
    calibration,
    correspondences,
    feature_pairs,
    interaction_matrix,
    motion_from_flow,
    pallet,
    pnp,
    reprojection,
    stereo_motion,
)
from jaxloc.refinement.pnp import refine_pose
from jaxloc.refinement.reprojection import Reprojection, StereoReprojection
from jaxloc.refinement.stereo_motion import StereoMatches, motion_problem, refine_motion

__all__ = [
    "Reprojection",
    "StereoMatches",
    "StereoReprojection",
    "association",
    "attributes",
    "bundle",
    "calibration",
    "correspondences",
    "feature_pairs",
    "interaction_matrix",
    "motion_from_flow",
    "motion_problem",
    "pallet",
    "pnp",
    "refine_motion",
    "refine_pose",
    "reprojection",
    "stereo_motion",
]
