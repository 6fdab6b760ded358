"""Alignment by mutual information: images whose gray levels follow from each other by no simple law.

It stays the same under any one-to-one map of gray levels, as inversion or gamma [K-22, R-35, R-36].
"""

from jaxloc.alignment.mutual_information.align import MutualInformation, align
from jaxloc.alignment.mutual_information.density import mutual_information

__all__ = ["MutualInformation", "align", "mutual_information"]
