"""Bundle adjustment: cameras and points together, from what the cameras saw of the points."""

from jaxloc.refinement.bundle.adjust import adjust
from jaxloc.refinement.bundle.estimate import BundleEstimate
from jaxloc.refinement.bundle.problem import Bundle, BundleProblem, Gauge, Observations
from jaxloc.refinement.bundle.structure import Structure

__all__ = ["Bundle", "BundleEstimate", "BundleProblem", "Gauge", "Observations", "Structure", "adjust"]
