"""Metrics, plots and reports."""

from jaxloc.evaluation import (
    alignments,
    consistency,
    drift,
    identities,
    plot,
    plot_map,
    plot_objects,
    plot_tracks,
    report,
    targets,
    trajectories,
    update_rate,
)
from jaxloc.evaluation.alignments import NoAlignment, RigidAlignment, SimilarityAlignment
from jaxloc.evaluation.drift import SegmentErrors, end_drift_percent, segment_errors
from jaxloc.evaluation.identities import BoxOverlap, PointDistance, clear_mot, compare, hota, id_f1
from jaxloc.evaluation.report import Section
from jaxloc.evaluation.targets import Gospa, Ospa, gospa, ospa, ospa2
from jaxloc.evaluation.trajectories import Frames, Meters, ate, rpe

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
    "alignments",
    "ate",
    "clear_mot",
    "compare",
    "consistency",
    "drift",
    "end_drift_percent",
    "gospa",
    "hota",
    "id_f1",
    "identities",
    "ospa",
    "ospa2",
    "plot",
    "plot_map",
    "plot_objects",
    "plot_tracks",
    "report",
    "rpe",
    "segment_errors",
    "targets",
    "trajectories",
    "update_rate",
]
