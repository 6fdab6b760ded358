"""Metrics, figures and reports."""

from jaxloc.evaluation import consistency, plots, report, targets, trajectories, update_rate
from jaxloc.evaluation.report import Section
from jaxloc.evaluation.targets.mot_metrics import BoxOverlap, PointDistance, clear_mot, compare, hota, id_f1
from jaxloc.evaluation.targets.ospa import Gospa, Ospa, gospa, ospa, ospa2
from jaxloc.evaluation.trajectories.alignment import NoAlignment, RigidAlignment, SimilarityAlignment
from jaxloc.evaluation.trajectories.ate import ate
from jaxloc.evaluation.trajectories.kitti_drift import SegmentErrors, end_drift_percent, segment_errors
from jaxloc.evaluation.trajectories.rpe import Frames, Meters, rpe

__all__ = [
    "BoxOverlap",
    "Frames",
    "Gospa",
    "Meters",
    "NoAlignment",
    "Ospa",
    "PointDistance",
    "RigidAlignment",
    "Section",
    "SegmentErrors",
    "SimilarityAlignment",
    "ate",
    "clear_mot",
    "compare",
    "consistency",
    "end_drift_percent",
    "gospa",
    "hota",
    "id_f1",
    "ospa",
    "ospa2",
    "plots",
    "report",
    "rpe",
    "segment_errors",
    "targets",
    "trajectories",
    "update_rate",
]
