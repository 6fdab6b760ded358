"""Camera calibration from images of a planar board: Zhang's method, nonlinear refinement and covariances."""

from jaxloc.refinement.calibration.camera import Calibrated, calibrate
from jaxloc.refinement.calibration.model import (
    BrownConradyModel,
    Fisheye,
    Intrinsics,
    LensModel,
    NoLens,
    Parametrization,
)
from jaxloc.refinement.calibration.problem import CameraProblem, Rig, StereoProblem, Unknowns
from jaxloc.refinement.calibration.stereo import CalibratedStereo, Corners, calibrate_stereo
from jaxloc.refinement.calibration.summary import Errors, Parameters, board_errors, camera_names, camera_parameters

__all__ = [
    "Calibrated",
    "CalibratedStereo",
    "CameraProblem",
    "Corners",
    "Errors",
    "Fisheye",
    "BrownConradyModel",
    "Intrinsics",
    "LensModel",
    "NoLens",
    "Parameters",
    "Parametrization",
    "Rig",
    "StereoProblem",
    "Unknowns",
    "board_errors",
    "calibrate",
    "calibrate_stereo",
    "camera_names",
    "camera_parameters",
]
