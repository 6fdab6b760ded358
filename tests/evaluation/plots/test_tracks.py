"""Figures of tracks: what is drawn where."""

import numpy as np

from jaxloc.evaluation import plots
from jaxloc.evaluation.report import encode_figure


def test_a_line_for_each_track(rng):
    places = rng.uniform(-5, 5, (6, 2, 3))
    ids = np.array([[3, 7]] * 3 + [[7, 3]] * 3)  # they change slots half way
    valid = np.ones((6, 2), bool)
    valid[0, 1] = False
    figure = plots.draw_tracks(places, ids, valid, truth=places, truth_valid=valid, camera=np.zeros((6, 3)))
    plot = figure.axes[0]
    truth, _, three, seven = (line.get_xydata() for line in plot.lines)
    assert len(truth) == 11
    np.testing.assert_array_equal(three, np.concatenate([places[:3, 0], places[3:, 1]])[:, [0, 2]])
    np.testing.assert_array_equal(seven, np.concatenate([places[1:3, 1], places[3:, 0]])[:, [0, 2]])
    assert [text.get_text() for text in plot.texts] == ["3", "7"]
    assert [text.get_text() for text in plot.get_legend().get_texts()] == ["truth", "camera"]
    assert encode_figure(figure).startswith("data:image/svg")


def test_pictures_point_down_and_nothing_is_drawn_of_nobody():
    nobody = np.zeros((4, 0, 4))
    figure = plots.draw_tracks(
        nobody, np.zeros((4, 0), int), np.zeros((4, 0), bool), axes=(0, 1), unit="px", downwards=True
    )
    plot = figure.axes[0]
    assert plot.yaxis.get_inverted() and not plot.lines and plot.get_ylabel() == "y (px)"


def test_numbers_of_targets():
    plot = plots.draw_counts(np.arange(3.0), np.array([0, 1, 2]), np.array([1, 1, 1])).axes[0]
    assert plot.lines[1].get_ydata().tolist() == [0, 1, 2] and len(plot.get_legend().get_texts()) == 2
    assert len(plots.draw_counts(np.arange(3.0), np.array([0, 1, 2])).axes[0].lines) == 1
