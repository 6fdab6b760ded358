"""Trajectory errors: ATE, RPE, KITTI drift."""

from jaxloc.evaluation.trajectories import alignment, kitti_drift, paths
from jaxloc.evaluation.trajectories.alignment import Alignment, NoAlignment, RigidAlignment, SimilarityAlignment
from jaxloc.evaluation.trajectories.ate import Errors, ate
from jaxloc.evaluation.trajectories.kitti_drift import (
    SegmentErrors,
    drift_curve_percent,
    end_drift_percent,
    fitting_lengths,
    segment_errors,
)
from jaxloc.evaluation.trajectories.paths import (
    check_lengths,
    path_distances,
    rotation_angle,
    safe_sqrt,
    step_lengths,
    synchronize,
)
from jaxloc.evaluation.trajectories.rpe import Frames, Meters, Pairs, RelativeErrors, Spacing, motion_differences, rpe

__all__ = [
    "Alignment",
    "Errors",
    "Frames",
    "Meters",
    "NoAlignment",
    "Pairs",
    "RelativeErrors",
    "RigidAlignment",
    "SegmentErrors",
    "SimilarityAlignment",
    "Spacing",
    "alignment",
    "ate",
    "check_lengths",
    "drift_curve_percent",
    "end_drift_percent",
    "fitting_lengths",
    "kitti_drift",
    "motion_differences",
    "path_distances",
    "paths",
    "rotation_angle",
    "rpe",
    "safe_sqrt",
    "segment_errors",
    "step_lengths",
    "synchronize",
]
