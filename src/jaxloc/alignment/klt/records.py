"""Options and results of KLT tracking."""

import equinox as eqx
from jaxtyping import Array, Bool, Float


class Klt(eqx.Module):
    """Options of KLT tracking.

    Attributes:
        size: Odd side of a patch, px.
        levels: Pyramid levels, the full image included.
        gain_freedom: Greatest ratio of a patch's gain to the gain of the whole image, either way.
        min_correlation: Least correlation of patches of a valid point.
        max_forward_backward: Greatest forward-backward error, px; None tracks forward only.
        least_sigma: Standard deviation of errors other than noise (interpolation, deformed patches), px.
        max_rounds: Greatest number of pixel cells on each level.
        num_steps: Gauss-Newton steps in a cell.
        chunk: Points that are processed at a time, to fit the cache; thousands on a GPU.
    """

    size: int = eqx.field(static=True, default=21)
    levels: int = eqx.field(static=True, default=4)
    gain_freedom: float = eqx.field(static=True, default=1.18)
    min_correlation: float = eqx.field(static=True, default=0.7)
    max_forward_backward: float | None = eqx.field(static=True, default=None)
    least_sigma: float = eqx.field(static=True, default=0.03)
    max_rounds: int = eqx.field(static=True, default=6)
    num_steps: int = eqx.field(static=True, default=5)
    chunk: int = eqx.field(static=True, default=64)

    def __check_init__(self):
        if self.size < 3 or self.size % 2 == 0:
            raise ValueError(f"Klt: the size must be odd and at least 3, not {self.size}.")
        if min(self.levels, self.max_rounds, self.num_steps, self.chunk) < 1 or self.gain_freedom < 1.0:
            raise ValueError("Klt: levels, max_rounds, num_steps, chunk and gain_freedom must be at least 1.")


class Tracked(eqx.Module):
    """Points of one image tracked in another.

    Attributes:
        points: Pixels (right, down) in the current image; the initial value where `ok` is False.
        ok: Whether the result is valid.
        residual: Root mean square of `I - g T - b` over the patch, gray levels.
        covariance: Of the pixels, px^2.
        gain: Contrast of the patch relative to the previous image.
        correlation: Of the two patches.
        forward_backward: Forward-backward error, px; zero where not computed.
    """

    points: Float[Array, "n 2"]
    ok: Bool[Array, " n"]
    residual: Float[Array, " n"]
    covariance: Float[Array, "n 2 2"]
    gain: Float[Array, " n"]
    correlation: Float[Array, " n"]
    forward_backward: Float[Array, " n"]
