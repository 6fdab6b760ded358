"""Plots of trajectories: path from above, uncertainty, drift, matches, stage timings.

matplotlib is an extra, loaded when the first figure is drawn; its global state (pyplot) is never touched.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float, UInt8

from jaxloc.evaluation.plots.canvas import add_curve, drawable, new_figure, start_at_zero
from jaxloc.poses import Trajectory

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_ESTIMATE, _TRUTH, _WRONG, _QUIET = "#0b6bcb", "#1b1f24", "#d1442f", "#8b949e"
# The ellipse of a planar Gaussian that holds 95 % lies at this many sigmas: the root of the chi-square quantile.
_SIGMAS_95 = 2.4477


def _figure(width: float, height: float) -> tuple[Any, Any]:
    figure = new_figure(width, height)
    axes = figure.add_subplot()
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(True, color="#e6e8eb", linewidth=0.8)
    axes.set_axisbelow(True)
    return figure, axes


def draw_trajectory(
    estimate: Trajectory,
    truth: Trajectory | None = None,
    covariances: Float[np.ndarray, "n 6 6"] | None = None,
    *,
    axes: tuple[int, int] = (0, 2),
    num_ellipses: int = 15,
) -> "Figure":
    """Draws a path from above, with the ellipses in which the position lies with 95 % probability.

    Args:
        estimate: the estimated path.
        truth: the true one.
        covariances: of the estimated poses ``T exp(d)``, translation first.
        axes: world axes that point right and up in the figure; x and z for paths of cameras. A path that is longer
            upwards than sideways is turned by 90 degrees, so that up is to the right.
        num_ellipses: how many ellipses, evenly along the path.

    Returns:
        The figure.

    Raises:
        ImportError: when matplotlib is not installed.
    """
    figure, plot = _figure(7.0, 4.6)
    right, up = axes
    path = drawable(estimate.positions)
    seen = path[np.isfinite(path).all(axis=1)]
    extent = np.ptp(seen, axis=0) if len(seen) else np.zeros(3)
    if extent[up] > extent[right]:
        right, up = up, right
        plot.yaxis.set_inverted(True)
    if truth is not None:
        true_path = drawable(truth.positions)
        add_curve(plot, true_path[:, right], true_path[:, up], color=_TRUTH, linewidth=2.5, alpha=0.35, label="truth")
    add_curve(plot, path[:, right], path[:, up], color=_ESTIMATE, linewidth=1.6, label="estimate")
    plot.plot(path[:1, right], path[:1, up], "o", color=_ESTIMATE, markersize=6)
    if covariances is not None:
        _add_ellipses(plot, np.asarray(estimate.matrices()), covariances, (right, up), num_ellipses)
    names = "xyz"
    plot.set_xlabel(f"{names[right]} (m)")
    plot.set_ylabel(f"{names[up]} (m)")
    plot.set_aspect("equal", adjustable="datalim")
    plot.legend(frameon=False)
    return figure


def _add_ellipses(plot, matrices, covariances, axes: tuple[int, int], count: int) -> None:
    from matplotlib.patches import Ellipse

    matrices, covariances = drawable(matrices), drawable(covariances)
    known = np.flatnonzero(np.isfinite(matrices).all(axis=(1, 2)) & np.isfinite(covariances).all(axis=(1, 2)))
    chosen = known[np.unique(np.linspace(0, len(known) - 1, count if len(known) else 0).round().astype(int))]
    for number, index in enumerate(chosen):
        rotation = matrices[index, :3, :3]
        position = rotation @ covariances[index][:3, :3] @ rotation.T
        variances, directions = np.linalg.eigh(position[np.ix_(axes, axes)])
        width, height = 2.0 * _SIGMAS_95 * np.sqrt(np.maximum(variances, 0.0))
        angle = np.degrees(np.arctan2(directions[1, 0], directions[0, 0]))
        center = matrices[index, list(axes), 3]
        label = "95 % of the position" if number == 0 else None
        style = dict(facecolor=_ESTIMATE, alpha=0.15, edgecolor=_ESTIMATE, linewidth=0.8)
        plot.add_patch(Ellipse(tuple(center), width, height, angle=angle, label=label, **style))


def draw_ellipses(
    estimate: Trajectory,
    covariances: Float[np.ndarray, "n 6 6"],
    truth: Trajectory | None = None,
) -> "Figure":
    """Draws three standard deviations of the position over time, in camera axes, with the error where it is known.

    Args:
        estimate: the estimated path.
        covariances: of the estimated poses ``T exp(d)``, translation first.
        truth: the true path, pose by pose.

    Returns:
        The figure.

    Raises:
        ImportError: when matplotlib is not installed.
    """
    figure, plot = _figure(7.0, 3.4)
    times = np.asarray(estimate.times)
    sigmas = np.sqrt(np.maximum(drawable(np.diagonal(covariances, axis1=1, axis2=2)[:, :3]), 0.0))
    colors = (_ESTIMATE, "#2f9e44", _WRONG)
    for axis, (name, color) in enumerate(zip(("right", "down", "forward"), colors, strict=True)):
        plot.fill_between(times, -3 * sigmas[:, axis], 3 * sigmas[:, axis], color=color, alpha=0.12, linewidth=0)
        if truth is not None:
            matrices = drawable(estimate.matrices())
            gap = drawable(truth.positions) - matrices[:, :3, 3]
            error = np.einsum("nij,ni->nj", matrices[:, :3, :3], gap)[:, axis]
            add_curve(plot, times, error, color=color, linewidth=1.4, label=name)
        else:
            add_curve(plot, times, 3 * sigmas[:, axis], color=color, linewidth=1.4, label=name)
    plot.set_xlabel("time (s)")
    plot.set_ylabel("position error and 3 sigma (m)" if truth is not None else "3 sigma (m)")
    plot.legend(frameon=False, ncols=3)
    return figure


def draw_drift(distances: Float[np.ndarray, " n"], percent: Float[np.ndarray, " n"]) -> "Figure":
    """Draws the drift along the path.

    Args:
        distances: traveled, m.
        percent: drift, % of the distance.

    Returns:
        The figure.

    Raises:
        ImportError: when matplotlib is not installed.
    """
    figure, plot = _figure(7.0, 3.0)
    add_curve(plot, distances, percent, color=_ESTIMATE, linewidth=1.6)
    plot.set_xlabel("distance traveled (m)")
    plot.set_ylabel("drift (% of the distance)")
    start_at_zero(plot, percent)
    return figure


def draw_matches(
    image: UInt8[np.ndarray, "h w"],
    previous: Float[np.ndarray, "n 2"],
    current: Float[np.ndarray, "n 2"],
    inlier: Bool[np.ndarray, " n"],
) -> "Figure":
    """Draws matches on the image of the current frame: a line from the previous to the current place of each feature.

    Args:
        image: gray values.
        previous: places in the previous frame, px.
        current: places in this frame, px.
        inlier: which matches agree with the estimated motion.

    Returns:
        The figure.

    Raises:
        ImportError: when matplotlib is not installed.
    """
    height, width = image.shape
    figure, plot = _figure(9.0, 9.0 * height / width + 0.4)
    previous, current = drawable(previous), drawable(current)
    plot.imshow(image, cmap="gray", vmin=0, vmax=255)
    for keep, color, label in ((inlier, "#37b24d", "agrees"), (~inlier, _WRONG, "rejected")):
        segments = np.stack([previous[keep], current[keep], np.full_like(current[keep], np.nan)], axis=1).reshape(-1, 2)
        plot.plot(segments[:, 0], segments[:, 1], color=color, linewidth=1.0, label=f"{label} ({int(keep.sum())})")
        plot.plot(current[keep, 0], current[keep, 1], ".", color=color, markersize=3.5)
    plot.set_xlim(-0.5, width - 0.5)
    plot.set_ylim(height - 0.5, -0.5)
    plot.set_axis_off()
    plot.legend(loc="lower right", fontsize=8, framealpha=0.85)
    return figure


def draw_timings(stages: Mapping[str, Float[np.ndarray, " n"]]) -> "Figure":
    """Draws how long each stage takes a frame: the median, and a thin line up to the 95th percentile.

    Args:
        stages: times by the name of the stage, s; those that are not finite are left out.

    Returns:
        The figure.

    Raises:
        ImportError: when matplotlib is not installed.
    """
    figure, plot = _figure(7.0, 0.9 + 0.4 * max(len(stages), 1))
    known = {name: times[np.isfinite(times)] for name, times in ((n, drawable(t)) for n, t in stages.items())}
    names = [name for name in list(stages)[::-1] if len(known[name])]
    medians = [1000.0 * float(np.median(known[name])) for name in names]
    slow = [1000.0 * float(np.percentile(known[name], 95)) for name in names]
    plot.barh(names, medians, color=_ESTIMATE, height=0.55)
    plot.hlines(names, medians, slow, color=_QUIET, linewidth=2.0)
    for name, median, end in zip(names, medians, slow, strict=True):
        plot.annotate(f" {median:.1f} ms", (end, name), va="center", fontsize=9, color=_TRUTH)
    plot.set_xlabel("time a frame (ms): median, and up to the 95th percentile")
    plot.grid(False, axis="y")
    return figure
