"""Metrics, plots and reports."""

from jaxloc.evaluation import alignments, consistency, drift, plot, plot_map, report, trajectories
from jaxloc.evaluation.alignments import NoAlignment, RigidAlignment, SimilarityAlignment
from jaxloc.evaluation.drift import SegmentErrors, end_drift_percent, segment_errors
from jaxloc.evaluation.report import Section
from jaxloc.evaluation.trajectories import Frames, Meters, ate, rpe

__all__ = [
    "Frames",
    "Meters",
    "NoAlignment",
    "RigidAlignment",
    "Section",
    "SegmentErrors",
    "SimilarityAlignment",
    "alignments",
    "ate",
    "consistency",
    "drift",
    "end_drift_percent",
    "plot",
    "plot_map",
    "report",
    "rpe",
    "segment_errors",
    "trajectories",
]
