"""Plots over a map: paths, particles, and curves over time.

matplotlib is an extra, loaded when the first figure is drawn; its global state (pyplot) is never touched.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from jaxloc.evaluation.plots.canvas import add_curve, drawable, new_figure, space_by_factors, start_at_zero

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_ESTIMATE, _TRUTH, _CLOUD, _QUIET = "#0b6bcb", "#1b1f24", "#d1442f", "#8b949e"
_FREE, _UNKNOWN, _WALL = 1.0, 0.88, 0.25
_ARROW = 0.7  # length of the arrow that shows a heading, m


class MapImage(eqx.Module):
    """A map as an image.

    Args:
        gray: "rows columns", the lowest row first; 0 black, 1 white.
        origin: (x, y, heading) of its lower left corner, m and rad.
        resolution: edge of a cell, m.
    """

    gray: Float[np.ndarray, "rows columns"]
    origin: tuple[float, float, float]
    resolution: float

    @staticmethod
    def of(
        occupied: Bool[np.ndarray, "rows columns"],
        free: Bool[np.ndarray, "rows columns"],
        origin: tuple[float, float, float],
        resolution: float,
    ) -> "MapImage":
        """Map image: dark obstacles, white free space, gray unknown cells."""
        return MapImage(np.where(occupied, _WALL, np.where(free, _FREE, _UNKNOWN)), origin, resolution)


class Snapshot(eqx.Module):
    """Particles at one time.

    Args:
        title: when.
        cloud: "m 3" particles (x, y, heading).
        pose: (x, y, heading) of the estimate.
        truth: (x, y, heading) of the robot where it is known.
    """

    title: str
    cloud: Float[np.ndarray, "m 3"]
    pose: Float[np.ndarray, "3"]
    truth: Float[np.ndarray, "3"] | None = None


def draw_map_path(
    grid: MapImage,
    poses: Float[np.ndarray, "n 3"],
    reference: Float[np.ndarray, "k 3"] | None = None,
    found: Bool[np.ndarray, " n"] | None = None,
) -> "Figure":
    """Draws a path over a map.

    Args:
        grid: the map.
        poses: estimated (x, y, heading), m and rad.
        reference: the path that it is compared with.
        found: which poses are to be trusted; the others are drawn as dots.

    Returns:
        The figure.

    Raises:
        ImportError: when matplotlib is not installed.
    """
    trusted = np.ones(len(poses), bool) if found is None else found
    figure = new_figure(9.0, 9.0 * _aspect(grid) + 0.6)
    plot = figure.add_subplot()
    _add_map(plot, grid)
    if reference is not None:
        add_curve(plot, reference[:, 0], reference[:, 1], color=_TRUTH, linewidth=2.6, alpha=0.35, label="reference")
    path = np.where(trusted[:, None], poses, np.nan)
    add_curve(plot, path[:, 0], path[:, 1], color=_ESTIMATE, linewidth=1.1, label="estimate")
    if not trusted.all():
        plot.plot(*drawable(poses[~trusted, :2]).T, ".", color=_CLOUD, markersize=3.0, label="not found yet")
    plot.legend(frameon=True, framealpha=0.85, fontsize=8, loc="best")
    return figure


def draw_clouds(grid: MapImage, snapshots: Sequence[Snapshot]) -> "Figure":
    """Draws particles over a map, one panel for each time.

    Args:
        grid: the map.
        snapshots: in order.

    Returns:
        The figure; empty without snapshots.

    Raises:
        ImportError: when matplotlib is not installed.
    """
    if not snapshots:
        return new_figure(10.0, 1.0)
    columns = min(len(snapshots), 2 if _aspect(grid) < 0.8 else 3)
    rows = -(-len(snapshots) // columns)
    width = 10.0 / columns
    figure = new_figure(10.0, rows * (width * _aspect(grid) + 0.35))
    for number, snapshot in enumerate(snapshots, start=1):
        plot = figure.add_subplot(rows, columns, number)
        _add_map(plot, grid)
        plot.plot(*drawable(snapshot.cloud[:, :2]).T, ".", color=_CLOUD, markersize=2.2, alpha=0.6)
        if snapshot.truth is not None:
            _add_arrow(plot, snapshot.truth, _TRUTH)
        _add_arrow(plot, snapshot.pose, _ESTIMATE)
        plot.set_title(snapshot.title, fontsize=9)
    return figure


def draw_curves(
    times: Float[np.ndarray, " n"],
    curves: Mapping[str, Float[np.ndarray, " n"]],
    label: str,
    *,
    logarithmic: bool = False,
) -> "Figure":
    """Draws numbers over time.

    Args:
        times: s.
        curves: by name; a number that is not finite, or beyond 1e100, leaves a gap.
        label: of the vertical axis, with the unit. The axis begins at zero where no number is negative.
        logarithmic: spaces that axis by factors; around zero linearly, where there are numbers that are not positive.

    Returns:
        The figure.

    Raises:
        ImportError: when matplotlib is not installed.
    """
    figure = new_figure(8.0, 3.0)
    plot = figure.add_subplot()
    plot.spines[["top", "right"]].set_visible(False)
    plot.grid(True, color="#e6e8eb", linewidth=0.8)
    for (name, values), color in zip(curves.items(), (_ESTIMATE, _CLOUD, _QUIET, _TRUTH), strict=False):
        add_curve(plot, times, values, color=color, linewidth=1.1, label=name)
    (space_by_factors if logarithmic else start_at_zero)(plot, *curves.values())
    plot.set_xlabel("time (s)")
    plot.set_ylabel(label)
    if len(curves) > 1:
        plot.legend(frameon=False, ncols=3, fontsize=8)
    return figure


def _extent(grid: MapImage) -> tuple[float, float, float, float]:
    rows, columns = grid.gray.shape
    return 0.0, columns * grid.resolution, 0.0, rows * grid.resolution


def _corners(grid: MapImage) -> np.ndarray:
    _, right, _, top = _extent(grid)
    x, y, heading = grid.origin
    points = np.array([[0.0, 0.0], [right, 0.0], [right, top], [0.0, top]])
    cos, sin = np.cos(heading), np.sin(heading)
    return points @ np.array([[cos, sin], [-sin, cos]]) + np.array([x, y])


def _aspect(grid: MapImage) -> float:
    width, height = np.ptp(_corners(grid), axis=0)
    return float(np.clip(height / width, 0.2, 2.0))


def _add_map(plot: Any, grid: MapImage) -> None:
    from matplotlib.transforms import Affine2D

    x, y, heading = grid.origin
    place = Affine2D().rotate(heading).translate(x, y) + plot.transData
    plot.imshow(grid.gray, cmap="gray", vmin=0, vmax=1, origin="lower", extent=_extent(grid), transform=place)
    corners = _corners(grid)
    plot.set_xlim(corners[:, 0].min(), corners[:, 0].max())
    plot.set_ylim(corners[:, 1].min(), corners[:, 1].max())
    plot.set_aspect("equal")
    plot.tick_params(labelsize=7)


def _add_arrow(plot: Any, pose: np.ndarray, color: str) -> None:
    x, y, heading = drawable(pose)
    if not np.isfinite(x + y + heading):
        return
    step = (_ARROW * np.cos(heading), _ARROW * np.sin(heading))
    style = dict(width=0.1, head_width=0.4, head_length=0.35, length_includes_head=False, linewidth=0, zorder=3)
    plot.arrow(x, y, *step, color=color, **style)
