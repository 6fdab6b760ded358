"""What is measured: forward models of cameras and stereo rigs, and their records."""

from jaxloc.sensors import camera, distortion, rig
from jaxloc.sensors.camera import Pinhole
from jaxloc.sensors.distortion import BrownConrady, KannalaBrandt, Lens
from jaxloc.sensors.rig import StereoRig

__all__ = [
    "BrownConrady",
    "KannalaBrandt",
    "Lens",
    "Pinhole",
    "StereoRig",
    "camera",
    "distortion",
    "rig",
]
