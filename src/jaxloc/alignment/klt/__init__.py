"""Kanade-Lucas-Tomasi tracking of thousands of points at once, proof against changes of exposure."""

from jaxloc.alignment.klt.frames import Frame
from jaxloc.alignment.klt.records import Klt, Tracked
from jaxloc.alignment.klt.track import prepare, track, track_frames, track_sequence

__all__ = ["Frame", "Klt", "Tracked", "prepare", "track", "track_frames", "track_sequence"]
