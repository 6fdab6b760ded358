"""How points are tracked, and what comes out."""

import equinox as eqx
from jaxtyping import Array, Bool, Float


class Klt(eqx.Module):
    """How points are tracked.

    Attributes:
        size: Odd side of a patch, px.
        levels: Pyramid levels, the full image included.
        gain_freedom: A patch's gain lies within this factor of the gain of the whole image.
        min_correlation: Least correlation of patches of a trusted point.
        max_forward_backward: Greatest distance at which tracking back may miss the point, px; None tracks forward only.
        least_sigma: Standard deviation of what noise does not show (interpolation, deformed patches), px.
        max_rounds: Pixel cells a point may visit on each level.
        num_steps: Gauss-Newton steps in a cell; they touch no pixel.
        chunk: Points that are worked on at a time: those that fit the cache; raise it to thousands on a GPU.
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
    """Where points of one image are seen in another.

    Attributes:
        points: Pixels (right, down) in the current image; the guess where `ok` is False.
        ok: Whether the result can be trusted.
        residual: Root mean square of `I - g T - b` over the patch, gray levels.
        covariance: Of the pixels, px^2.
        gain: Contrast of the patch relative to the previous image.
        correlation: Of the two patches.
        forward_backward: Distance at which tracking back misses the point, px; zero where it was not asked for.
    """

    points: Float[Array, "n 2"]
    ok: Bool[Array, " n"]
    residual: Float[Array, " n"]
    covariance: Float[Array, "n 2 2"]
    gain: Float[Array, " n"]
    correlation: Float[Array, " n"]
    forward_backward: Float[Array, " n"]
