"""Synthetic worlds that give the library's own records, with exact truth."""

from jaxloc.data.simulate import (
    camera,
    ceiling,
    floor,
    landmarks,
    laser,
    points,
    rendering,
    road,
    road_drive,
    road_geometry,
    targets,
    textures,
    world,
)

__all__ = [
    "camera",
    "ceiling",
    "floor",
    "landmarks",
    "laser",
    "points",
    "rendering",
    "road",
    "road_drive",
    "road_geometry",
    "targets",
    "textures",
    "world",
]
