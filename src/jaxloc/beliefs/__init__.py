"""How surely we know: Gaussians on any state, and how uncertainty passes through functions and gates."""

from jaxloc.beliefs import (
    adaptive,
    compounding,
    conditional,
    fixed_point,
    gates,
    gaussian,
    mixture,
    particles,
    propagation,
    reduction,
    resampling,
    squareroot,
    transport,
)
from jaxloc.beliefs.adaptive import KLDSize
from jaxloc.beliefs.compounding import compose, invert, relative
from jaxloc.beliefs.conditional import Motion, Sensor
from jaxloc.beliefs.gates import chi2_cdf, chi2_quantile, gate
from jaxloc.beliefs.gaussian import Gaussian, fuse
from jaxloc.beliefs.mixture import Mixture
from jaxloc.beliefs.particles import Particles
from jaxloc.beliefs.propagation import propagate_linear, propagate_sampled, propagate_unscented
from jaxloc.beliefs.reduction import Closeness, KullbackLeibler, MahalanobisDistance, reduce_mixture

__all__ = [
    "Closeness",
    "Gaussian",
    "KLDSize",
    "KullbackLeibler",
    "MahalanobisDistance",
    "Mixture",
    "Motion",
    "Particles",
    "Sensor",
    "adaptive",
    "chi2_cdf",
    "chi2_quantile",
    "compose",
    "compounding",
    "conditional",
    "fixed_point",
    "fuse",
    "gate",
    "gates",
    "gaussian",
    "invert",
    "mixture",
    "particles",
    "propagate_linear",
    "propagate_sampled",
    "propagate_unscented",
    "propagation",
    "reduce_mixture",
    "reduction",
    "relative",
    "resampling",
    "squareroot",
    "transport",
]
