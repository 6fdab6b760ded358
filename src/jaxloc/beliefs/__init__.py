"""How surely we know: Gaussians on any state, and how uncertainty passes through functions and gates."""

from jaxloc.beliefs import compounding, conditional, gates, gaussian, propagation, squareroot
from jaxloc.beliefs.compounding import compose, invert, relative
from jaxloc.beliefs.conditional import Motion, Sensor
from jaxloc.beliefs.gates import chi2_cdf, chi2_quantile, gate
from jaxloc.beliefs.gaussian import Gaussian, fuse
from jaxloc.beliefs.propagation import propagate_linear, propagate_sampled, propagate_unscented

__all__ = [
    "Gaussian",
    "Motion",
    "Sensor",
    "chi2_cdf",
    "chi2_quantile",
    "compose",
    "compounding",
    "conditional",
    "fuse",
    "gate",
    "gates",
    "gaussian",
    "invert",
    "propagate_linear",
    "propagate_sampled",
    "propagate_unscented",
    "propagation",
    "relative",
    "squareroot",
]
