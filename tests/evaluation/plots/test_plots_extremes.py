"""Every figure of data with both signs, of none, one, huge and missing numbers: it is drawn, and nothing is hidden."""

import io

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.evaluation import plots
from jaxloc.poses import SE3, SO3, Trajectory

VALUES = {
    "both signs": [-2.0, 3.0, -1.0, 4.0],
    "negative": [-2.0, -3.0, -1.0, -4.0],
    "empty": [],
    "one": [-2.0],
    "zeros": [0.0, 0.0],
    "huge": [1e30, -1e30, 1.0, 2.0],
    "largest": [float(np.finfo(np.float64).max), float(np.finfo(np.float64).min), 1.0],
    "missing": [np.nan, -1.0, np.nan, np.inf, 2.0, 3.0, -np.inf],
    "all missing": [np.nan, np.nan],
}


def path_of(values):
    # float32 as JAX has it, so that its largest stands for that of float64.
    with np.errstate(over="ignore"):
        values = np.clip(np.asarray(values), -3.4e38, 3.4e38).astype(np.float32)
    rotation = np.tile(np.eye(3, dtype=np.float32), (len(values), 1, 1))
    positions = np.stack([values, 0 * values, values[::-1]], axis=1)
    poses = jax.vmap(lambda r, t: SE3(SO3(r), t))(jnp.asarray(rotation), jnp.asarray(positions))
    return Trajectory(jnp.arange(float(len(values))), poses), np.asarray(values, float)


def of_trajectory(values):
    path, values = path_of(values)
    return [path, path, np.abs(values)[:, None, None] * np.eye(6)]


def of_ellipses(values):
    path, values = path_of(values)
    return [path, np.abs(values)[:, None, None] * np.eye(6), path]


def of_tracks(values):
    places = np.stack([values, values, values[::-1]], axis=1)[:, None]
    here = np.ones(places.shape[:2], bool)
    return [places, np.zeros(here.shape, int), here]


def grid():
    occupied = np.eye(4, 6, dtype=bool)
    return plots.MapImage.of(occupied, ~occupied, (-1.0, 2.0, 0.5), 0.5)


def pixels():
    return np.full((20, 30), 128, np.uint8)


ARGUMENTS = {
    "draw_clouds": lambda v: [grid(), [plots.Snapshot("now", np.stack([v] * 3, axis=1), np.zeros(3))] * min(len(v), 3)],
    "draw_counts": lambda v: [np.arange(float(len(v))), np.nan_to_num(np.clip(v, -9, 9)).astype(int)],
    "draw_curves": lambda v: [np.arange(float(len(v))), {"one": v, "other": -v}, "offset (m)"],
    "draw_drift": lambda v: [np.arange(float(len(v))), v],
    "draw_ellipses": of_ellipses,
    "draw_map_path": lambda v: [grid(), np.stack([v] * 3, axis=1), np.stack([v] * 3, axis=1), v > 0],
    "draw_matches": lambda v: [pixels(), np.stack([v, v], axis=1), np.stack([v, v[::-1]], axis=1), v > 0],
    "draw_objects": lambda v: [
        pixels(),
        np.stack([v, v], axis=1),
        np.stack([v, v, v + 1.0, v + 1.0], axis=1),
        np.stack([v, v], axis=1),
        np.arange(len(v)),
        v,
    ],
    "draw_timings": lambda v: [{"solve": v, "match": np.abs(v)}],
    "draw_tracks": of_tracks,
    "draw_trajectory": of_trajectory,
}


def rendered(figure):
    figure.savefig(io.BytesIO(), format="png", dpi=40)
    figure.savefig(io.BytesIO(), format="svg")
    return figure


def test_every_figure_is_here():
    assert set(ARGUMENTS) == {name for name in plots.__all__ if name.startswith("draw_")}


QUICK = ("both signs", "empty", "missing")
CASES = [pytest.param(name, marks=() if name in QUICK else pytest.mark.slow) for name in VALUES]


@pytest.mark.parametrize("values", CASES)
@pytest.mark.parametrize("name", ARGUMENTS)
def test_it_can_be_drawn(name, values):
    figure = rendered(getattr(plots, name)(*ARGUMENTS[name](np.array(VALUES[values]))))
    assert all(np.isfinite([*axes.get_xlim(), *axes.get_ylim()]).all() for axes in figure.axes)


def shown(axes):
    """Places with ink: ends of line segments, and markers."""
    low, high = axes.get_ylim()
    seen = set()
    for line in axes.lines:
        y = np.asarray(line.get_ydata(), float)
        joined = np.isfinite(y) & (np.isfinite(np.r_[np.nan, y[:-1]]) | np.isfinite(np.r_[y[1:], np.nan]))
        drawn = np.isfinite(y) if line.get_marker() not in ("None", None, "") else joined
        seen |= {float(value) for value in y[drawn] if min(low, high) <= value <= max(low, high)}
    return seen


@pytest.mark.parametrize("logarithmic", [False, True])
@pytest.mark.parametrize("values", VALUES)
def test_curves_hide_nothing(values, logarithmic):
    numbers = np.array(VALUES[values])
    figure = plots.draw_curves(np.arange(float(len(numbers))), {"a": numbers}, "m", logarithmic=logarithmic)
    axes = rendered(figure).axes[0]
    assert {float(v) for v in numbers[np.abs(numbers) < 1e100]} <= shown(axes)


def test_curves_that_are_not_negative_start_at_zero():
    axes = plots.draw_curves(np.arange(3.0), {"a": np.array([5.0, 6.0, 7.0])}, "m").axes[0]
    assert axes.get_ylim()[0] == 0.0


def test_a_pose_on_its_own_is_drawn():
    """Between poses that are not trusted, a track of one frame, a drive of one pose."""
    poses = np.array([[0.0, 1.0, 0.0], [1.0, 2.0, 0.0], [2.0, 3.0, 0.0]])
    assert 2.0 in shown(plots.draw_map_path(grid(), poses, None, np.array([False, True, False])).axes[0])
    assert 7.0 in shown(plots.draw_tracks(*of_tracks(np.array([7.0]))).axes[0])
    assert 5.0 in shown(plots.draw_drift(np.zeros(1), np.array([5.0])).axes[0])
    path, _ = path_of([2.0])
    axes = plots.draw_ellipses(path, np.eye(6)[None], None).axes[0]
    assert 3.0 in shown(axes)


def test_negative_timings_and_drift_are_inside():
    axes = plots.draw_drift(np.arange(3.0), np.array([-1.0, -2.0, -3.0])).axes[0]
    assert {-1.0, -2.0, -3.0} <= shown(axes)
