"""Bayes filters and smoothers: the Kalman family, particle filters, histogram filters, interacting models."""

from jaxloc.filters import (
    extended,
    histogram,
    information,
    interacting_models,
    interface,
    kalman,
    localization,
    motion_models,
    parallel,
    particle,
    proposals,
    smoothers,
    unscented,
)
from jaxloc.filters.extended import ExtendedKalmanFilter
from jaxloc.filters.histogram import HistogramFilter, HistogramInfo, HistogramState
from jaxloc.filters.information import InformationFilter, InformationInfo, InformationState
from jaxloc.filters.interacting_models import (
    InteractingInfo,
    InteractingMultipleModel,
    InteractingState,
    smooth_interacting,
)
from jaxloc.filters.interface import Filter, FilterState, GaussianInfo, GaussianState, History, Info, run
from jaxloc.filters.kalman import GaussianFilter, KalmanFilter, LinearSensor
from jaxloc.filters.localization import LocalizationInfo, LocalizationState, MonteCarloLocalization, Place, Recovery
from jaxloc.filters.motion_models import (
    BodyTwist,
    ConstantAcceleration,
    ConstantVelocity,
    CoordinatedTurn,
    LinearMotion,
    TwistMotion,
)
from jaxloc.filters.parallel.filter_smoother import run_parallel, smooth_parallel
from jaxloc.filters.particle import ParticleFilter, ParticleInfo, ParticleState
from jaxloc.filters.proposals import Auxiliary, Bootstrap, Guided
from jaxloc.filters.smoothers import smooth, smooth_fixed_lag
from jaxloc.filters.unscented import Cubature, GaussHermite, SigmaPointFilter, Unscented

__all__ = [
    "Auxiliary",
    "BodyTwist",
    "Bootstrap",
    "ConstantAcceleration",
    "ConstantVelocity",
    "CoordinatedTurn",
    "Cubature",
    "ExtendedKalmanFilter",
    "Filter",
    "FilterState",
    "GaussHermite",
    "GaussianFilter",
    "GaussianInfo",
    "GaussianState",
    "HistogramFilter",
    "HistogramInfo",
    "HistogramState",
    "Guided",
    "History",
    "Info",
    "InformationFilter",
    "InformationInfo",
    "InformationState",
    "InteractingMultipleModel",
    "KalmanFilter",
    "LinearMotion",
    "LinearSensor",
    "LocalizationInfo",
    "LocalizationState",
    "InteractingInfo",
    "InteractingState",
    "MonteCarloLocalization",
    "ParticleFilter",
    "ParticleInfo",
    "ParticleState",
    "Place",
    "Recovery",
    "SigmaPointFilter",
    "TwistMotion",
    "Unscented",
    "extended",
    "histogram",
    "information",
    "interacting_models",
    "interface",
    "kalman",
    "localization",
    "motion_models",
    "parallel",
    "particle",
    "proposals",
    "run",
    "run_parallel",
    "smooth",
    "smooth_fixed_lag",
    "smooth_interacting",
    "smooth_parallel",
    "smoothers",
    "unscented",
]
