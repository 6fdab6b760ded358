"""Bundle adjustment: joint estimation of camera poses and points from image observations."""

from jaxloc.refinement.bundle.adjust import adjust
from jaxloc.refinement.bundle.estimate import BundleEstimate
from jaxloc.refinement.bundle.problem import Bundle, BundleProblem, Gauge, Observations
from jaxloc.refinement.bundle.structure import Structure

__all__ = ["Bundle", "BundleEstimate", "BundleProblem", "Gauge", "Observations", "Structure", "adjust"]
