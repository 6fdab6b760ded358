"""Probability densities on any pytree: Gaussians, mixtures and particles; propagation, gates and resampling."""

from jaxloc.beliefs import (
    compounding,
    gates,
    gaussian,
    kld_sampling,
    mixture,
    mixture_reduction,
    models,
    particles,
    propagation,
    resampling,
    square_root,
    validity,
)
from jaxloc.beliefs.compounding import compose, invert, relative
from jaxloc.beliefs.gates import chi2_cdf, chi2_quantile, gate
from jaxloc.beliefs.gaussian import Gaussian, fuse
from jaxloc.beliefs.kld_sampling import KLDSize
from jaxloc.beliefs.mixture import Mixture
from jaxloc.beliefs.mixture_reduction import Closeness, KullbackLeibler, MahalanobisDistance, reduce_mixture
from jaxloc.beliefs.models import Motion, Sensor
from jaxloc.beliefs.particles import Particles
from jaxloc.beliefs.propagation import propagate_linear, propagate_sampled, propagate_unscented

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
    "chi2_cdf",
    "chi2_quantile",
    "compose",
    "compounding",
    "fuse",
    "gate",
    "gates",
    "gaussian",
    "invert",
    "kld_sampling",
    "mixture",
    "mixture_reduction",
    "models",
    "particles",
    "propagate_linear",
    "propagate_sampled",
    "propagate_unscented",
    "propagation",
    "reduce_mixture",
    "relative",
    "resampling",
    "square_root",
    "validity",
]
