"""Detectors and descriptors of OpenCV, on the host."""

from jaxloc.features.opencv import backend, chessboard, detectors
from jaxloc.features.opencv.backend import create, load, to_uint8
from jaxloc.features.opencv.chessboard import board_points, find_chessboard
from jaxloc.features.opencv.describe import describe
from jaxloc.features.opencv.detect import detect
from jaxloc.features.opencv.detectors import (
    AKAZE,
    FAST,
    KAZE,
    ORB,
    SIFT,
    AbstractCorner,
    AbstractDetector,
    AbstractFeature,
    Candidates,
    Harris,
    ShiTomasi,
    from_opencv,
)

__all__ = [
    "AKAZE",
    "AbstractCorner",
    "AbstractDetector",
    "AbstractFeature",
    "Candidates",
    "FAST",
    "Harris",
    "KAZE",
    "ORB",
    "SIFT",
    "ShiTomasi",
    "backend",
    "board_points",
    "chessboard",
    "create",
    "describe",
    "detect",
    "detectors",
    "find_chessboard",
    "from_opencv",
    "to_uint8",
    "load",
]
