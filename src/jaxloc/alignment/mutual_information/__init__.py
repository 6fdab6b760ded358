"""Alignment by mutual information: pictures whose grey levels follow from each other by no simple law.

It stays the same under any one-to-one map of grey levels, as inversion or gamma [K-22, R-35, R-36].
"""

from jaxloc.alignment.mutual_information.align import MutualInformation, align
from jaxloc.alignment.mutual_information.density import mutual_information

__all__ = ["MutualInformation", "align", "mutual_information"]
