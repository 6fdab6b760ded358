"""Lucas-Kanade: a template laid upon an image by the derivatives of their grey levels."""

from jaxloc.alignment.lucas_kanade.align import align
from jaxloc.alignment.lucas_kanade.brightness import Bias, Brightness, Correlation, GainBias, Unchanged
from jaxloc.alignment.lucas_kanade.descents import (
    Descent,
    DiagonalStep,
    GaussNewtonStep,
    LevenbergMarquardtStep,
    NewtonStep,
    SteepestDescentStep,
)
from jaxloc.alignment.lucas_kanade.formulations import (
    Formulation,
    ForwardsAdditive,
    ForwardsCompositional,
    InverseAdditive,
    InverseCompositional,
)
from jaxloc.alignment.lucas_kanade.scales import Blurred, FullSize, Pyramid, Scales
from jaxloc.alignment.lucas_kanade.settings import LucasKanade

__all__ = [
    "Bias",
    "Blurred",
    "Brightness",
    "Correlation",
    "Descent",
    "DiagonalStep",
    "Formulation",
    "ForwardsAdditive",
    "ForwardsCompositional",
    "FullSize",
    "GainBias",
    "GaussNewtonStep",
    "InverseAdditive",
    "InverseCompositional",
    "LevenbergMarquardtStep",
    "LucasKanade",
    "NewtonStep",
    "Pyramid",
    "Scales",
    "SteepestDescentStep",
    "Unchanged",
    "align",
]
