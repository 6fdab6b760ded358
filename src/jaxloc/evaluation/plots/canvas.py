"""What all figures share: an empty one, curves with gaps in which nothing is hidden, and their limits.

matplotlib is an extra, loaded when the first figure is drawn; its global state (pyplot) is never touched.
"""

from typing import Any

import numpy as np
from jaxtyping import Float

# Larger numbers leave a gap: limits and ticks are sums and differences of what is drawn, and must not overflow.
LARGEST = 1e100


def new_figure(width: float, height: float) -> Any:
    """An empty figure, its sizes in inches.

    Raises:
        ImportError: when matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError('figures need matplotlib: pip install "jaxloc[plot]"') from error
    return Figure(figsize=(width, height), layout="constrained", facecolor="white")


def drawable(values: Any) -> Float[np.ndarray, "..."]:
    """The numbers in double precision, NaN in place of those that cannot be drawn: not finite, or beyond 1e100."""
    values = np.asarray(values, np.float64)
    with np.errstate(invalid="ignore"):
        return np.where(np.abs(values) <= LARGEST, values, np.nan)


def add_curve(plot: Any, x: Any, y: Any, **style: Any) -> None:
    """Adds a line with gaps where a coordinate cannot be drawn, and dots for what stands alone between gaps.

    A line through a single point would show nothing.
    """
    x, y = drawable(x), drawable(y)
    there = np.isfinite(x) & np.isfinite(y)
    plot.plot(x, np.where(there, y, np.nan), **style)
    padded = np.concatenate([[False], there, [False]])
    alone = there & ~padded[:-2] & ~padded[2:]
    if alone.any():
        size = 1.0 + 2.0 * style.get("linewidth", 1.0)
        dots = dict(color=style.get("color"), alpha=style.get("alpha"), markersize=size, label="_dots")
        plot.plot(x[alone], y[alone], ".", **dots)


def start_at_zero(plot: Any, *values: Any) -> None:
    """Lets the vertical axis begin at zero where no number is negative; otherwise zero is marked by a line."""
    numbers = np.concatenate([drawable(part).ravel() for part in values] or [np.zeros(0)])
    if (numbers < 0).any():
        plot.axhline(0.0, color="#8b949e", linewidth=0.8, zorder=1)
    else:
        plot.set_ylim(bottom=0.0)
        if not (numbers > 0).any():
            plot.set_ylim(top=1.0)


def space_by_factors(plot: Any, *values: Any) -> None:
    """Makes the vertical axis logarithmic; linear around zero where a number is not positive, which would be hidden."""
    numbers = np.concatenate([drawable(part).ravel() for part in values] or [np.zeros(0)])
    sizes = np.abs(numbers[np.isfinite(numbers) & (numbers != 0)])
    if (numbers <= 0).any() or not len(sizes):
        plot.set_yscale("symlog", linthresh=float(np.clip(sizes.min(initial=1.0), 1e-6 * sizes.max(initial=1.0), None)))
    else:
        plot.set_yscale("log")
