"""Kanade-Lucas-Tomasi (KLT) tracking of many points at once, with gain and bias of every patch."""

from jaxloc.alignment.klt.frames import Frame
from jaxloc.alignment.klt.records import Klt, Tracked
from jaxloc.alignment.klt.track import prepare, track, track_frames, track_sequence

__all__ = ["Frame", "Klt", "Tracked", "prepare", "track", "track_frames", "track_sequence"]
