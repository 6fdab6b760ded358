"""Template matching by exhaustive search: all positions are scored, the best is refined to subpixels.

It needs no initial value, and returns all peaks of the score on request,
and the covariance of the best [K-24, K-26, K-93].
"""

from jaxloc.alignment.correlation.classify import Classification, classify
from jaxloc.alignment.correlation.matched_filter import ColoredNoise, Noise, Response, WhiteNoise, respond, threshold
from jaxloc.alignment.correlation.peaks import Parabola, Peaks, find_peaks, fit_parabola
from jaxloc.alignment.correlation.scores import (
    Correlator,
    Direct,
    Fourier,
    NormalizedCorrelation,
    Score,
    SumOfSquares,
    ZeroMeanCorrelation,
)
from jaxloc.alignment.correlation.search import Window, score_map, search

__all__ = [
    "Classification",
    "ColoredNoise",
    "Correlator",
    "Direct",
    "Fourier",
    "Noise",
    "NormalizedCorrelation",
    "Parabola",
    "Peaks",
    "Response",
    "Score",
    "SumOfSquares",
    "WhiteNoise",
    "Window",
    "ZeroMeanCorrelation",
    "classify",
    "find_peaks",
    "fit_parabola",
    "respond",
    "score_map",
    "search",
    "threshold",
]
