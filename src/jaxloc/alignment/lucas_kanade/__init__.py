"""Lucas-Kanade image alignment: formulations, descents, brightness models, pyramids and covariance."""

from jaxloc.alignment.lucas_kanade.align import align
from jaxloc.alignment.lucas_kanade.brightness import Bias, Brightness, Correlation, GainBias, Unchanged
from jaxloc.alignment.lucas_kanade.formulations import (
    Formulation,
    ForwardsAdditive,
    ForwardsCompositional,
    InverseAdditive,
    InverseCompositional,
)
from jaxloc.alignment.lucas_kanade.options import LucasKanade
from jaxloc.alignment.lucas_kanade.scales import Blurred, FullSize, Pyramid, Scales
from jaxloc.alignment.lucas_kanade.steps import (
    Descent,
    DiagonalStep,
    GaussNewtonStep,
    LevenbergMarquardtStep,
    NewtonStep,
    SteepestDescentStep,
)

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
