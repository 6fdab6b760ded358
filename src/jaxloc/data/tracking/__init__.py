"""Detections and labeled tracks of tracking benchmarks, as padded arrays by frame."""

from jaxloc.data.tracking import kitti_tracking, mot, records, tracks_csv
from jaxloc.data.tracking.kitti_tracking import KittiCalibration, KittiTracking, read_kitti_tracking
from jaxloc.data.tracking.mot import read_mot_detections, read_mot_tracks, write_mot
from jaxloc.data.tracking.records import Detections, LabeledTracks

__all__ = [
    "Detections",
    "KittiCalibration",
    "KittiTracking",
    "LabeledTracks",
    "kitti_tracking",
    "mot",
    "read_kitti_tracking",
    "read_mot_detections",
    "read_mot_tracks",
    "records",
    "tracks_csv",
    "write_mot",
]
