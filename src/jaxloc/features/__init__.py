"""Keypoint detectors, descriptors, matching and subpixel refinement."""

from jaxloc.features import (
    brief,
    fast,
    harris,
    kaze,
    kaze_words,
    keypoints,
    match,
    opencv,
    orb,
    scale_space,
    select,
    sift,
    subpixel,
    surf,
)
from jaxloc.features.keypoints import Descriptors, Keypoints, Matches

__all__ = [
    "Descriptors",
    "Keypoints",
    "Matches",
    "brief",
    "fast",
    "harris",
    "kaze",
    "kaze_words",
    "keypoints",
    "match",
    "opencv",
    "orb",
    "scale_space",
    "select",
    "sift",
    "subpixel",
    "surf",
]
