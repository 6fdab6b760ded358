"""Filters and smoothers that are parallel in time, by associative scans."""

from jaxloc.filters.parallel import associative_scan, filter_smoother
from jaxloc.filters.parallel.associative_scan import (
    Block,
    Line,
    Linearized,
    filter_blocks,
    hold,
    scan_associative,
    smooth_blocks,
)
from jaxloc.filters.parallel.filter_smoother import run_parallel, smooth_parallel

__all__ = [
    "Block",
    "Line",
    "Linearized",
    "associative_scan",
    "filter_blocks",
    "filter_smoother",
    "hold",
    "run_parallel",
    "scan_associative",
    "smooth_blocks",
    "smooth_parallel",
]
