"""Images of moving objects: what is drawn, and where."""

import io

import cv2
import numpy as np

from jaxloc.evaluation import plots


def test_points_boxes_and_labels_are_drawn_where_they_are():
    image = np.full((60, 120), 100, np.uint8)
    points, boxes = np.array([[30.0, 20.0]]), np.array([[20.0, 10.0, 40.0, 30.0]])
    figure = plots.draw_objects(image, points, boxes, np.array([[30.0, 20.0]]), np.array([7]), np.array([12.3]))
    (plot,) = figure.axes
    assert plot.texts[0].get_text() == "7: 12.3 m/s"
    assert plot.patches[0].get_bbox().bounds == (16.0, 6.0, 28.0, 28.0)
    np.testing.assert_array_equal(plot.lines[0].get_xydata(), points)
    png = np.frombuffer(plots.encode(figure), np.uint8)
    assert cv2.imdecode(png, cv2.IMREAD_COLOR).shape[1] == 1000
    assert io.BytesIO(png.tobytes()).read(4) == b"\x89PNG"


def test_nobody_is_a_picture_too():
    none = np.zeros((0, 2))
    figure = plots.draw_objects(
        np.zeros((20, 30), np.uint8), none, np.zeros((0, 4)), none, np.zeros(0, int), np.zeros(0)
    )
    assert not figure.axes[0].texts
