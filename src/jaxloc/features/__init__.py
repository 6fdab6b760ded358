"""Keypoint detectors, descriptors, matching and subpixel refinement; one module a method.

`features.sift.sift`, `features.surf.surf`, `features.kaze.kaze`, `features.akaze.akaze`, `features.orb.orb`,
`features.fast.fast` and `features.harris.harris` run in JAX; `features.opencv.detect` and `features.opencv.describe`
run OpenCV on the host.
"""

from jaxloc.features import (
    akaze,
    brief,
    fast,
    harris,
    kaze,
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
    "akaze",
    "brief",
    "fast",
    "harris",
    "kaze",
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
