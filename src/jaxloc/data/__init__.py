"""Files and synthetic worlds that give the library's own records."""

from jaxloc.data import (
    covariance,
    kitti,
    png,
    sequence,
    simulate,
    tables,
    tum,
    writing,
)
from jaxloc.data.kitti import KittiSequence
from jaxloc.data.sequence import DataError, StereoFrame, StereoSequence
from jaxloc.data.simulate.camera import StreetSequence, simulate_street
from jaxloc.data.simulate.points import StereoDrive, StereoPairs, simulate_stereo_points

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
    "sequence",
    "simulate",
    "simulate_stereo_points",
    "simulate_street",
    "tables",
    "tum",
    "writing",
]
