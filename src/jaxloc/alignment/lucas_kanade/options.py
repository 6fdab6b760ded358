"""Options of Lucas-Kanade alignment."""

import equinox as eqx

from jaxloc.alignment.lucas_kanade.brightness import Brightness, GainBias
from jaxloc.alignment.lucas_kanade.formulations import Formulation, InverseCompositional
from jaxloc.alignment.lucas_kanade.scales import Pyramid, Scales
from jaxloc.alignment.lucas_kanade.steps import Descent, GaussNewtonStep
from jaxloc.images.interpolation import AbstractInterpolation, Bilinear
from jaxloc.solvers.robust_kernels import Loss, Quadratic


class LucasKanade(eqx.Module):
    """Options of an alignment.

    Attributes:
        formulation: `InverseCompositional`, `ForwardsCompositional`, `ForwardsAdditive` or `InverseAdditive`.
        descent: `GaussNewtonStep`, `LevenbergMarquardtStep`, `NewtonStep`, `DiagonalStep` or `SteepestDescentStep`.
        brightness: `GainBias`, `Bias` or `Unchanged`.
        scales: `Pyramid`, `Blurred` or `FullSize`.
        loss: robust kernel on residuals in sigmas; an unknown sigma is estimated by the median of absolute residuals.
        interpolation: of the image.
        max_steps: bound on the number of steps at each scale.
        tolerance: step length at convergence, px; larger at coarser scales.
        template_noise: standard deviation of the template's noise over that of the image's: 1 for two images of one
            camera, 0 for a clean map.
        min_coverage: least fraction of the template within the image.
        min_correlation: least correlation of a valid result.
        normalized: whether unknowns are in units of the template's size. Gauss-Newton is invariant to it; in pixels
            from the corner, as in the paper, steepest descent and diagonal Hessians fail.
    """

    formulation: Formulation = InverseCompositional()
    descent: Descent = GaussNewtonStep()
    brightness: Brightness = GainBias()
    scales: Scales = Pyramid()
    loss: Loss = Quadratic()
    interpolation: AbstractInterpolation = Bilinear()
    max_steps: int = eqx.field(static=True, default=30)
    tolerance: float = eqx.field(static=True, default=2e-3)
    template_noise: float = eqx.field(static=True, default=1.0)
    min_coverage: float = eqx.field(static=True, default=0.5)
    min_correlation: float = eqx.field(static=True, default=0.5)
    normalized: bool = eqx.field(static=True, default=True)
