"""Blobs of nonlinear scale spaces: KAZE by implicit, A-KAZE by fast explicit diffusion, in JAX."""

from jaxloc.images.diffused import scale_space, words
from jaxloc.images.diffused.kaze import Kaze, describe_kaze, kaze
from jaxloc.images.diffused.scale_space import DiffusedScaleSpace, ExplicitCycle, Splitting
from jaxloc.images.diffused.words import MLdb, MSurf

__all__ = [
    "DiffusedScaleSpace",
    "ExplicitCycle",
    "Kaze",
    "MLdb",
    "MSurf",
    "Splitting",
    "describe_kaze",
    "kaze",
    "scale_space",
    "words",
]
