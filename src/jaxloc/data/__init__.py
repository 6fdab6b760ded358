"""Files and synthetic worlds that give the library's own records."""

from jaxloc.data import (
    bundle,
    camera_file,
    carmen,
    covariance,
    kitti,
    landmarks,
    lanes,
    laser_log,
    maps,
    png,
    sequence,
    simulate,
    tables,
    tracking,
    tum,
    wean,
    writing,
)
from jaxloc.data.kitti import KittiSequence
from jaxloc.data.laser_log import LaserLog
from jaxloc.data.sequence import DataError, StereoFrame, StereoSequence
from jaxloc.data.simulate.camera import StreetSequence, simulate_street
from jaxloc.data.simulate.laser import LaserDrive, simulate_laser_drive
from jaxloc.data.simulate.points import StereoDrive, StereoPairs, simulate_stereo_points

__all__ = [
    "DataError",
    "KittiSequence",
    "LaserDrive",
    "LaserLog",
    "StereoDrive",
    "StereoFrame",
    "StereoPairs",
    "StereoSequence",
    "StreetSequence",
    "bundle",
    "camera_file",
    "carmen",
    "covariance",
    "kitti",
    "landmarks",
    "lanes",
    "laser_log",
    "maps",
    "png",
    "sequence",
    "simulate",
    "simulate_laser_drive",
    "simulate_stereo_points",
    "simulate_street",
    "tables",
    "tracking",
    "tum",
    "wean",
    "writing",
]
