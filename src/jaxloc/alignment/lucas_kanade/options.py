"""All choices of an alignment in one record."""

import equinox as eqx

from jaxloc.alignment.lucas_kanade.brightness import Brightness, GainBias
from jaxloc.alignment.lucas_kanade.formulations import Formulation, InverseCompositional
from jaxloc.alignment.lucas_kanade.scales import Pyramid, Scales
from jaxloc.alignment.lucas_kanade.steps import Descent, GaussNewtonStep
from jaxloc.images.interpolation import AbstractInterpolation, Bilinear
from jaxloc.solvers.robust_kernels import Loss, Quadratic


class LucasKanade(eqx.Module):
    """How two images are aligned.

    Attributes:
        formulation: `InverseCompositional`, `ForwardsCompositional`, `ForwardsAdditive` or `InverseAdditive`.
        descent: `GaussNewtonStep`, `LevenbergMarquardtStep`, `NewtonStep`, `DiagonalStep` or `SteepestDescentStep`.
        brightness: `GainBias`, `Bias` or `Unchanged`.
        scales: `Pyramid`, `Blurred` or `FullSize`.
        loss: robust kernel on residuals in sigmas; the median of their sizes gives sigma where none is known.
        interpolation: of the image.
        max_steps: bound on the number of steps at each scale.
        tolerance: length of a step that counts as none, px; coarser scales are content with more.
        template_noise: standard deviation of the template's noise over that of the image's: 1 for two images of one
            camera, 0 for a clean map.
        min_coverage: least part of the template that must lie on the image.
        min_correlation: least correlation of a trusted result.
        normalized: whether unknowns are counted in units of the template. Gauss-Newton does not care; in pixels counted
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
