"""Synthetic roads with lane markings, and drives along them."""

from jaxloc.data.simulate.road import geometry, rendering
from jaxloc.data.simulate.road.drive import Course, RoadDrive, drive
from jaxloc.data.simulate.road.geometry import ExactClothoid, RoadGeometry, SmallAngles
from jaxloc.data.simulate.road.rendering import Change, Mark, Road, Shadows, Streak, render

__all__ = [
    "Change",
    "Course",
    "ExactClothoid",
    "Mark",
    "Road",
    "RoadDrive",
    "RoadGeometry",
    "Shadows",
    "SmallAngles",
    "Streak",
    "drive",
    "geometry",
    "render",
    "rendering",
]
