"""Models that all trackers share: target motion and detection, birth, clutter."""

from jaxloc.tracking.models import birth, clutter, target
from jaxloc.tracking.models.birth import Birth, MeasuredBirth, PointBirth, StaticBirth
from jaxloc.tracking.models.clutter import Clutter, FrustumClutter, UniformClutter
from jaxloc.tracking.models.target import ConstantDetection, Detection, FieldOfView, TargetModel

__all__ = [
    "Birth",
    "Clutter",
    "ConstantDetection",
    "Detection",
    "FieldOfView",
    "FrustumClutter",
    "MeasuredBirth",
    "PointBirth",
    "StaticBirth",
    "TargetModel",
    "UniformClutter",
    "birth",
    "clutter",
    "target",
]
