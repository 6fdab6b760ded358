"""Synthetic worlds that give the library's own records, with exact truth."""

from jaxloc.data.simulate import camera, landmarks, laser, points, rendering, targets, textures, world

__all__ = [
    "camera",
    "landmarks",
    "laser",
    "points",
    "rendering",
    "targets",
    "textures",
    "world",
]
