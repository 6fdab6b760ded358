"""Recordings with point landmarks, as filter steps."""

from jaxloc.data.landmarks import factors, log, mrclam, ranging
from jaxloc.data.landmarks.factors import read_factors
from jaxloc.data.landmarks.log import LandmarkLog
from jaxloc.data.landmarks.mrclam import read_mrclam
from jaxloc.data.landmarks.ranging import read_ranging

__all__ = [
    "LandmarkLog",
    "factors",
    "log",
    "mrclam",
    "ranging",
    "read_factors",
    "read_mrclam",
    "read_ranging",
]
