"""Figures over maps: what is drawn where."""

import numpy as np
import pytest

from jaxloc.evaluation import plots
from jaxloc.evaluation.report import encode_figure


@pytest.fixture
def grid(rng):
    occupied = rng.uniform(size=(20, 40)) < 0.1
    return plots.MapImage.of(occupied, ~occupied, (-1.0, 2.0, np.pi / 2), 0.5)


def test_a_path_over_a_turned_map(grid, rng):
    poses = rng.uniform(-3, 3, (30, 3))
    figure = plots.draw_map_path(grid, poses, poses[::3], np.arange(30) > 4)
    axes = figure.axes[0]
    # Turned by a quarter: 20 m upwards, 10 m to the left of the origin.
    np.testing.assert_allclose([*axes.get_xlim(), *axes.get_ylim()], [-11.0, -1.0, 2.0, 22.0], atol=1e-9)
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["reference", "estimate", "not found yet"]
    path = axes.lines[1].get_xydata()
    assert np.isnan(path[:5]).all()
    np.testing.assert_allclose(path[5:], poses[5:, :2])
    assert encode_figure(figure, raster=True).startswith("data:image/png")


def test_clouds_side_by_side(grid, rng):
    clouds = [plots.Snapshot(f"{n} s", rng.uniform(-3, 3, (9, 3)), np.zeros(3), np.ones(3)) for n in range(5)]
    figure = plots.draw_clouds(grid, clouds)
    assert [axes.get_title() for axes in figure.axes] == ["0 s", "1 s", "2 s", "3 s", "4 s"]
    assert all(len(axes.lines[0].get_xydata()) == 9 for axes in figure.axes)
    encode_figure(figure, raster=True)


def test_curves():
    times = np.arange(5.0)
    figure = plots.draw_curves(times, {"a": times + 1.0, "b": 2.0 * times + 1.0}, "error (m)", logarithmic=True)
    axes = figure.axes[0]
    assert axes.get_yscale() == "log" and axes.get_ylabel() == "error (m)"
    np.testing.assert_allclose(axes.lines[1].get_ydata(), 2.0 * times + 1.0)
    encode_figure(figure)
