"""Sensor models: cameras, laser range finders, landmarks, ranging and odometers, and the maps they refer to."""

from jaxloc.sensors import (
    beam_model,
    camera,
    ground_camera,
    increments,
    landmarks,
    laser_scan,
    lenses,
    likelihood_field,
    maps,
    moving_objects,
    odometer,
    ranging,
    stereo_rig,
)
from jaxloc.sensors.beam_model import BeamModel
from jaxloc.sensors.camera import Pinhole
from jaxloc.sensors.ground_camera import GroundCamera
from jaxloc.sensors.increments import Increment, IncrementMotion
from jaxloc.sensors.landmarks import DescribedReading, RangeBearing, RangeBearingSensor
from jaxloc.sensors.laser_scan import LaserScan
from jaxloc.sensors.lenses import BrownConrady, KannalaBrandt, Lens
from jaxloc.sensors.likelihood_field import LikelihoodField
from jaxloc.sensors.maps.ceiling import CeilingMosaic, CeilingSensor
from jaxloc.sensors.maps.distance_field import DistanceField
from jaxloc.sensors.maps.occupancy_map import FreeSpace, OccupancyMap
from jaxloc.sensors.maps.textured_plane import Predicted, TexturedPlane
from jaxloc.sensors.moving_objects import MovingObject, MovingObjectSensor
from jaxloc.sensors.odometer import DifferentialDrive, OdometryMotion
from jaxloc.sensors.ranging import Range, RangeSensor, RangingMotion, RangingState
from jaxloc.sensors.stereo_rig import StereoRig

__all__ = [
    "BeamModel",
    "BrownConrady",
    "CeilingMosaic",
    "CeilingSensor",
    "DescribedReading",
    "DifferentialDrive",
    "DistanceField",
    "FreeSpace",
    "GroundCamera",
    "Increment",
    "IncrementMotion",
    "KannalaBrandt",
    "LaserScan",
    "Lens",
    "LikelihoodField",
    "MovingObject",
    "MovingObjectSensor",
    "OccupancyMap",
    "OdometryMotion",
    "Pinhole",
    "Predicted",
    "Range",
    "RangeBearing",
    "RangeBearingSensor",
    "RangeSensor",
    "RangingMotion",
    "RangingState",
    "StereoRig",
    "TexturedPlane",
    "beam_model",
    "camera",
    "ground_camera",
    "increments",
    "landmarks",
    "laser_scan",
    "lenses",
    "likelihood_field",
    "maps",
    "moving_objects",
    "odometer",
    "ranging",
    "stereo_rig",
]
