"""One estimate carried through time: Bayes filters as pure steps, and smoothers."""

from jaxloc.filters import contract
from jaxloc.filters.contract import Filter, FilterState, GaussianInfo, GaussianState, History, Info, run

__all__ = [
    "Filter",
    "FilterState",
    "GaussianInfo",
    "GaussianState",
    "History",
    "Info",
    "contract",
    "run",
]
