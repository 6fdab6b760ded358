"""Resampling of particles: schemes, differentiable variants and optimal transport."""

from jaxloc.beliefs.resampling import cumulative_weights, indices, strategies
from jaxloc.beliefs.resampling.cumulative_weights import Boundaries, boundaries, bounded_values
from jaxloc.beliefs.resampling.indices import multinomial, residual, soft, stratified, systematic
from jaxloc.beliefs.resampling.optimal_transport import optimal_transport
from jaxloc.beliefs.resampling.strategies import (
    Multinomial,
    OptimalTransport,
    Resampled,
    Resampling,
    Residual,
    Soft,
    Stratified,
    Systematic,
    by_ancestors,
)

__all__ = [
    "Boundaries",
    "Multinomial",
    "OptimalTransport",
    "Resampled",
    "Resampling",
    "Residual",
    "Soft",
    "Stratified",
    "Systematic",
    "boundaries",
    "bounded_values",
    "by_ancestors",
    "cumulative_weights",
    "indices",
    "multinomial",
    "optimal_transport",
    "residual",
    "soft",
    "strategies",
    "stratified",
    "systematic",
]
