"""Recordings with point landmarks, as filter steps."""

from jaxloc.data.landmarks import factor_list, landmark_log, mrclam, ranging
from jaxloc.data.landmarks.factor_list import read_factors
from jaxloc.data.landmarks.landmark_log import LandmarkLog
from jaxloc.data.landmarks.mrclam import read_mrclam
from jaxloc.data.landmarks.ranging import read_ranging

__all__ = [
    "LandmarkLog",
    "factor_list",
    "landmark_log",
    "mrclam",
    "ranging",
    "read_factors",
    "read_mrclam",
    "read_ranging",
]
