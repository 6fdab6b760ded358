"""Figures."""

from jaxloc.evaluation.plots import canvas, maps, objects, tracks, trajectories
from jaxloc.evaluation.plots.maps import MapImage, Snapshot, draw_clouds, draw_curves, draw_map_path
from jaxloc.evaluation.plots.objects import draw_objects, encode
from jaxloc.evaluation.plots.tracks import draw_counts, draw_tracks
from jaxloc.evaluation.plots.trajectories import draw_drift, draw_ellipses, draw_matches, draw_timings, draw_trajectory

__all__ = [
    "MapImage",
    "Snapshot",
    "canvas",
    "draw_clouds",
    "draw_counts",
    "draw_curves",
    "draw_drift",
    "draw_ellipses",
    "draw_map_path",
    "draw_matches",
    "draw_objects",
    "draw_timings",
    "draw_tracks",
    "draw_trajectory",
    "encode",
    "maps",
    "objects",
    "tracks",
    "trajectories",
]
