"""One estimate carried through time: Bayes filters as pure steps, and smoothers."""

from jaxloc.filters import (
    blocks,
    contract,
    extended,
    grid,
    information,
    kalman,
    localization,
    modes,
    motion,
    parallel,
    particle,
    proposals,
    rao_blackwell,
    smoothers,
    unscented,
)
from jaxloc.filters.contract import Filter, FilterState, GaussianInfo, GaussianState, History, Info, run
from jaxloc.filters.extended import ExtendedKalmanFilter
from jaxloc.filters.grid import GridFilter, GridInfo, GridState
from jaxloc.filters.information import InformationFilter, InformationInfo, InformationState
from jaxloc.filters.kalman import GaussianFilter, KalmanFilter, LinearSensor
from jaxloc.filters.localization import LocalizationInfo, LocalizationState, MonteCarloLocalization, Place, Recovery
from jaxloc.filters.modes import InteractingFilters, ModesInfo, ModesState, smooth_modes
from jaxloc.filters.motion import (
    BodyTwist,
    ConstantAcceleration,
    ConstantVelocity,
    CoordinatedTurn,
    LinearMotion,
    TwistMotion,
)
from jaxloc.filters.parallel import run_parallel, smooth_parallel
from jaxloc.filters.particle import ParticleFilter, ParticleInfo, ParticleState
from jaxloc.filters.proposals import Auxiliary, Bootstrap, Guided
from jaxloc.filters.rao_blackwell import Appearance, DescriptorFastSlam, FastSlam, FastSlamInfo, FastSlamState
from jaxloc.filters.smoothers import smooth, smooth_fixed_lag
from jaxloc.filters.unscented import Cubature, GaussHermite, SigmaPointFilter, Unscented

__all__ = [
    "Appearance",
    "Auxiliary",
    "BodyTwist",
    "Bootstrap",
    "ConstantAcceleration",
    "ConstantVelocity",
    "CoordinatedTurn",
    "Cubature",
    "DescriptorFastSlam",
    "ExtendedKalmanFilter",
    "FastSlam",
    "FastSlamInfo",
    "FastSlamState",
    "Filter",
    "FilterState",
    "GaussHermite",
    "GaussianFilter",
    "GaussianInfo",
    "GaussianState",
    "GridFilter",
    "GridInfo",
    "GridState",
    "Guided",
    "History",
    "Info",
    "InformationFilter",
    "InformationInfo",
    "InformationState",
    "InteractingFilters",
    "KalmanFilter",
    "LinearMotion",
    "LinearSensor",
    "LocalizationInfo",
    "LocalizationState",
    "ModesInfo",
    "ModesState",
    "MonteCarloLocalization",
    "ParticleFilter",
    "ParticleInfo",
    "ParticleState",
    "Place",
    "Recovery",
    "SigmaPointFilter",
    "TwistMotion",
    "Unscented",
    "blocks",
    "contract",
    "extended",
    "grid",
    "information",
    "kalman",
    "localization",
    "modes",
    "motion",
    "parallel",
    "particle",
    "proposals",
    "rao_blackwell",
    "run",
    "run_parallel",
    "smooth",
    "smooth_fixed_lag",
    "smooth_modes",
    "smooth_parallel",
    "smoothers",
    "unscented",
]
