"""Alignment by mutual information: for images without a simple relation of gray levels.

It is invariant to any one-to-one map of gray levels, as inversion or gamma [K-22, R-35, R-36].
"""

from jaxloc.alignment.mutual_information.align import MutualInformation, align
from jaxloc.alignment.mutual_information.density import mutual_information

__all__ = ["MutualInformation", "align", "mutual_information"]
