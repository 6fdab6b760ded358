"""Detectors and descriptors of OpenCV, on the host."""

from jaxloc.features.opencv import chessboard, detectors, library
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
from jaxloc.features.opencv.library import create, gray_bytes, load

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
    "board_points",
    "chessboard",
    "create",
    "describe",
    "detect",
    "detectors",
    "find_chessboard",
    "from_opencv",
    "gray_bytes",
    "library",
    "load",
]
