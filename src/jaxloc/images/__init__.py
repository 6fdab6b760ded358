"""Pixels to samples, keypoints and matches."""

from jaxloc.images import (
    corners,
    describe,
    detect,
    detectors,
    gradients,
    interpolation,
    keypoints,
    match,
    opencv,
    patches,
    pyramid,
    select,
    subpixel,
)
from jaxloc.images.interpolation import Bicubic, Bilinear
from jaxloc.images.keypoints import Descriptors, Keypoints, Matches

__all__ = [
    "Bicubic",
    "Bilinear",
    "Descriptors",
    "Keypoints",
    "Matches",
    "corners",
    "describe",
    "detect",
    "detectors",
    "gradients",
    "interpolation",
    "keypoints",
    "match",
    "opencv",
    "patches",
    "pyramid",
    "select",
    "subpixel",
]
