"""Maps: occupancy grids, distance fields, textured planes and ceilings."""

from jaxloc.sensors.maps import ceiling, distance_field, occupancy_map, textured_plane
from jaxloc.sensors.maps.ceiling import CeilingMosaic, CeilingSensor
from jaxloc.sensors.maps.distance_field import DistanceField, squared_distances, trace
from jaxloc.sensors.maps.occupancy_map import FreeSpace, OccupancyMap
from jaxloc.sensors.maps.textured_plane import Predicted, TexturedPlane

__all__ = [
    "CeilingMosaic",
    "CeilingSensor",
    "DistanceField",
    "FreeSpace",
    "OccupancyMap",
    "Predicted",
    "TexturedPlane",
    "ceiling",
    "distance_field",
    "occupancy_map",
    "squared_distances",
    "textured_plane",
    "trace",
]
