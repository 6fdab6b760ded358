"""Multi-target metrics: OSPA, GOSPA, CLEAR MOT, IDF1 and HOTA."""

from jaxloc.evaluation.targets import mot_metrics
from jaxloc.evaluation.targets.mot_metrics import (
    BoxOverlap,
    ClearMot,
    Comparison,
    Hota,
    IdF1,
    PointDistance,
    Similarity,
    clear_mot,
    compare,
    hota,
    id_f1,
    join,
)
from jaxloc.evaluation.targets.ospa import Gospa, Ospa, gospa, ospa, ospa2

__all__ = [
    "BoxOverlap",
    "ClearMot",
    "Comparison",
    "Gospa",
    "Hota",
    "IdF1",
    "Ospa",
    "PointDistance",
    "Similarity",
    "clear_mot",
    "compare",
    "gospa",
    "hota",
    "id_f1",
    "join",
    "mot_metrics",
    "ospa",
    "ospa2",
]
