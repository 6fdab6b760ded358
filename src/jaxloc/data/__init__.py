"""Readers and writers of files, and simulators with ground truth."""

from jaxloc.data import (
    camera_file,
    carmen,
    covariance_csv,
    gtsam_stereo,
    io,
    kitti,
    landmarks,
    laser_log,
    road_images,
    ros_map,
    simulate,
    stereo_sequence,
    tracking,
    tum,
    wean_hall,
)
from jaxloc.data.io.errors import DataError
from jaxloc.data.kitti import KittiSequence
from jaxloc.data.laser_log import LaserLog
from jaxloc.data.simulate.laser import LaserDrive, simulate_laser_drive
from jaxloc.data.simulate.stereo_points import StereoDrive, StereoPairs, simulate_stereo_points
from jaxloc.data.simulate.street.sequence import StreetSequence, simulate_street
from jaxloc.data.stereo_sequence import StereoFrame, StereoSequence

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
    "camera_file",
    "carmen",
    "covariance_csv",
    "gtsam_stereo",
    "io",
    "kitti",
    "landmarks",
    "laser_log",
    "road_images",
    "ros_map",
    "simulate",
    "simulate_laser_drive",
    "simulate_stereo_points",
    "simulate_street",
    "stereo_sequence",
    "tracking",
    "tum",
    "wean_hall",
]
