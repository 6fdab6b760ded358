"""Plots of tracks: paths from above, and counts over time.

matplotlib is an extra, loaded when the first figure is drawn; its global state (pyplot) is never touched.
"""

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxloc.evaluation.plots.canvas import add_curve, drawable, new_figure, start_at_zero

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_TRUTH, _CAMERA, _QUIET = "#1b1f24", "#8b949e", "#e6e8eb"
_COLORS = ("#0b6bcb", "#d1442f", "#2a9d4b", "#8a4fbf", "#d98c00", "#0f8b8d", "#b83280", "#6b7280")


def draw_tracks(
    places: Float[np.ndarray, "t k d"],
    ids: Int[np.ndarray, "t k"],
    valid: Bool[np.ndarray, "t k"],
    *,
    truth: Float[np.ndarray, "t n d"] | None = None,
    truth_valid: Bool[np.ndarray, "t n"] | None = None,
    camera: Float[np.ndarray, "t d"] | None = None,
    axes: tuple[int, int] = (0, 2),
    unit: str = "m",
    downwards: bool = False,
) -> "Figure":
    """Draws the path of each track in a color of its own, with its number where it ends.

    Args:
        places: of the tracks.
        ids: who they are.
        valid: which there are.
        truth: true places, drawn as a shade below.
        truth_valid: which there are.
        camera: places of the camera.
        axes: of the places that point right and up in the figure; x and z for a view from above.
        unit: of the places.
        downwards: whether the second of them points down, as in images.

    Returns:
        The figure.

    Raises:
        ImportError: when matplotlib is not installed.
    """
    figure = new_figure(8.0, 5.5)
    plot = figure.add_subplot()
    plot.grid(True, color=_QUIET, linewidth=0.8)
    plot.set_axisbelow(True)
    right, up = axes
    if truth is not None:
        shown = drawable(truth)[np.ones(truth.shape[:2], bool) if truth_valid is None else truth_valid]
        plot.plot(shown[:, right], shown[:, up], ".", color=_TRUTH, markersize=5, alpha=0.15, label="truth")
    if camera is not None:
        add_curve(plot, camera[:, right], camera[:, up], color=_CAMERA, linewidth=1.2, linestyle="--", label="camera")
    for identity in np.unique(ids[valid]).tolist():
        path = _path(drawable(places), valid & (ids == identity))
        color = _COLORS[identity % len(_COLORS)]
        add_curve(plot, path[:, right], path[:, up], color=color, linewidth=1.3)
        ends = path[np.isfinite(path).all(axis=1)][-1:]
        for end in ends:
            plot.annotate(str(identity), end[[right, up]], fontsize=6, color=color)
    names = "xyz"
    plot.set_xlabel(f"{names[right]} ({unit})")
    plot.set_ylabel(f"{names[up]} ({unit})")
    plot.set_aspect("equal", adjustable="datalim")
    plot.yaxis.set_inverted(downwards)
    if truth is not None or camera is not None:
        plot.legend(frameon=False, fontsize=8)
    return figure


def draw_counts(
    times: Float[np.ndarray, " t"], found: Int[np.ndarray, " t"], truth: Int[np.ndarray, " t"] | None = None
) -> "Figure":
    """Draws the number of targets over time.

    Args:
        times: s.
        found: how many tracks there are.
        truth: how many targets there are.

    Returns:
        The figure.

    Raises:
        ImportError: when matplotlib is not installed.
    """
    figure = new_figure(8.0, 2.6)
    plot = figure.add_subplot()
    plot.spines[["top", "right"]].set_visible(False)
    plot.grid(True, color=_QUIET, linewidth=0.8)
    if truth is not None:
        plot.step(times, truth, where="post", color=_TRUTH, linewidth=2.5, alpha=0.35, label="truth")
    # Without a marker a single instant would not be seen.
    marker = "." if len(times) == 1 else ""
    plot.step(times, found, where="post", color=_COLORS[0], linewidth=1.2, marker=marker, label="tracks")
    start_at_zero(plot, found, *(() if truth is None else (truth,)))
    plot.set_xlabel("time (s)")
    plot.set_ylabel("number")
    plot.legend(frameon=False, ncols=2, fontsize=8)
    return figure


def _path(places: np.ndarray, there: np.ndarray) -> np.ndarray:
    """Places of one track in the order of frames."""
    frames, slots = np.nonzero(there)
    return places[frames, slots]
