"""What is measured: forward models of cameras and stereo rigs, and their records."""

from jaxloc.sensors import (
    camera,
    ceiling,
    distortion,
    ground,
    increments,
    landmarks,
    lane,
    laser,
    maps,
    moving_objects,
    odometer,
    ranging,
    rig,
    textured_plane,
)
from jaxloc.sensors.camera import Pinhole
from jaxloc.sensors.ceiling import CeilingMosaic, CeilingSensor
from jaxloc.sensors.distortion import BrownConrady, KannalaBrandt, Lens
from jaxloc.sensors.ground import GroundCamera
from jaxloc.sensors.increments import Increment, IncrementMotion
from jaxloc.sensors.landmarks import DescribedReading, RangeBearing, RangeBearingSensor
from jaxloc.sensors.lane import Lane
from jaxloc.sensors.laser import BeamModel, LaserScan, LikelihoodField
from jaxloc.sensors.maps import DistanceField, FreeSpace, OccupancyMap
from jaxloc.sensors.moving_objects import MovingObject, MovingObjectSensor
from jaxloc.sensors.odometer import DifferentialDrive, OdometryMotion
from jaxloc.sensors.ranging import Range, RangeSensor, RangingMotion, RangingState
from jaxloc.sensors.rig import StereoRig
from jaxloc.sensors.textured_plane import Predicted, TexturedPlane

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
    "Lane",
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
    "camera",
    "ceiling",
    "distortion",
    "ground",
    "increments",
    "landmarks",
    "lane",
    "laser",
    "maps",
    "moving_objects",
    "odometer",
    "ranging",
    "rig",
    "textured_plane",
]
