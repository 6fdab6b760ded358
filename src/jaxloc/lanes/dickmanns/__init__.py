"""Dickmanns's lane tracker: lane borders by sums along their predicted direction, and a clothoid in a Kalman filter."""

from jaxloc.lanes.dickmanns.borders import Borders, EdgeThresholds, measure
from jaxloc.lanes.dickmanns.edges import Edge, EdgeDetector, LightStripe, SingleEdge, find_edge
from jaxloc.lanes.dickmanns.model import BorderSensor, LaneMotion, Ride, RoadState
from jaxloc.lanes.dickmanns.windows import ColumnSums, Windows, sum_columns

__all__ = [
    "BorderSensor",
    "Borders",
    "ColumnSums",
    "Edge",
    "EdgeDetector",
    "LaneMotion",
    "LightStripe",
    "Ride",
    "RoadState",
    "SingleEdge",
    "EdgeThresholds",
    "Windows",
    "find_edge",
    "measure",
    "sum_columns",
]
