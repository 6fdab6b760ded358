"""Files and synthetic worlds that give the library's own records."""

from jaxloc.data import (
    covariance,
    kitti,
    png,
    rendering,
    sequence,
    simulate_camera,
    simulate_points,
    simulate_world,
    tables,
    textures,
    tum,
    writing,
)
from jaxloc.data.kitti import KittiSequence
from jaxloc.data.sequence import DataError, StereoFrame, StereoSequence
from jaxloc.data.simulate_camera import StreetSequence, simulate_street
from jaxloc.data.simulate_points import StereoDrive, StereoPairs, simulate_stereo_points

__all__ = [
    "DataError",
    "KittiSequence",
    "StereoDrive",
    "StereoFrame",
    "StereoPairs",
    "StereoSequence",
    "StreetSequence",
    "covariance",
    "kitti",
    "png",
    "rendering",
    "sequence",
    "simulate_camera",
    "simulate_points",
    "simulate_stereo_points",
    "simulate_street",
    "simulate_world",
    "tables",
    "textures",
    "tum",
    "writing",
]
