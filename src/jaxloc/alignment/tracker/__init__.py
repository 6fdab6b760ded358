"""Kanade-Lucas-Tomasi tracking of thousands of points at once, proof against changes of exposure."""

from jaxloc.alignment.tracker.frames import Frame
from jaxloc.alignment.tracker.records import Klt, Tracked
from jaxloc.alignment.tracker.track import prepare, track, track_frames, track_sequence

__all__ = ["Frame", "Klt", "Tracked", "prepare", "track", "track_frames", "track_sequence"]
