"""Tracking of ready detections: 3-D objects or image boxes."""

from jaxloc.pipelines.detection_tracking import models, options, tracking
from jaxloc.pipelines.detection_tracking.models import (
    Frame,
    Noise,
    PlaceSensor,
    ScoredBirth,
    ScoredClutter,
    ScoredDetection,
    Step,
    WatchedTracker,
    is_in_view,
)
from jaxloc.pipelines.detection_tracking.options import Belief, Config, Gnn, Jpda, Movement, Phd, Scene, Strategy
from jaxloc.pipelines.detection_tracking.tracking import Tracked, make_tracker, track

__all__ = [
    "Belief",
    "Config",
    "Frame",
    "Gnn",
    "Jpda",
    "Movement",
    "Noise",
    "Phd",
    "PlaceSensor",
    "Scene",
    "ScoredBirth",
    "ScoredClutter",
    "ScoredDetection",
    "Step",
    "Strategy",
    "Tracked",
    "WatchedTracker",
    "is_in_view",
    "make_tracker",
    "models",
    "options",
    "track",
    "tracking",
]
