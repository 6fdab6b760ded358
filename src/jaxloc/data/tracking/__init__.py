"""Ready detections and labeled tracks, as padded arrays by frame."""

from jaxloc.data.tracking import kitti_tracking, mot, records
from jaxloc.data.tracking.kitti_tracking import KittiCalibration, KittiTracking, read_kitti_tracking
from jaxloc.data.tracking.mot import read_mot_detections, read_mot_tracks, write_mot
from jaxloc.data.tracking.records import Detections, LabelledTracks

__all__ = [
    "Detections",
    "KittiCalibration",
    "KittiTracking",
    "LabelledTracks",
    "kitti_tracking",
    "mot",
    "read_kitti_tracking",
    "read_mot_detections",
    "read_mot_tracks",
    "records",
    "write_mot",
]
