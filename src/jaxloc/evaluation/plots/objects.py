"""Annotated frames: moving points, measured objects, tracks."""

import io
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Int

from jaxloc.evaluation.plots.canvas import drawable, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_DPI = 100


def draw_objects(
    image: Any,
    points: Float[np.ndarray, "n 2"],
    boxes: Float[np.ndarray, "k 4"],
    uv: Float[np.ndarray, "m 2"],
    labels: Int[np.ndarray, " m"],
    speeds: Float[np.ndarray, " m"],
) -> "Figure":
    """Draws moving points, objects and tracks on a frame.

    Args:
        image: gray image.
        points: moving points, px.
        boxes: (left, top, right, bottom) of measured objects, px.
        uv: where tracks are, px.
        labels: their numbers.
        speeds: m/s.

    Returns:
        The figure; what has no finite place is left out.

    Raises:
        ImportError: when matplotlib is not installed.
    """
    pixels = np.asarray(image)
    height, width = pixels.shape
    figure = new_figure(10.0, 10.0 * height / width + 0.3)
    from matplotlib.patches import Rectangle

    points, boxes, uv = drawable(points), drawable(boxes), drawable(uv)
    plot = figure.add_subplot()
    plot.imshow(pixels, cmap="gray", vmin=0, vmax=255)
    plot.plot(points[:, 0], points[:, 1], ".", color="#e8590c", markersize=3)
    for left, top, right, bottom in boxes[np.isfinite(boxes).all(axis=1)]:
        plot.add_patch(
            Rectangle((left - 4, top - 4), right - left + 8, bottom - top + 8, fill=False, color="#ffd43b", linewidth=1)
        )
    for (u, v), label, speed in zip(uv, labels, speeds, strict=True):
        if not np.isfinite(u + v):
            continue
        plot.plot(u, v, "+", color="#4dabf7", markersize=10)
        plot.annotate(
            f"{label}: {speed:.1f} m/s", (u, v), xytext=(4, 10), textcoords="offset points", color="#4dabf7", fontsize=8
        )
    plot.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
    plot.set_axis_off()
    return figure


def encode(figure: "Figure") -> bytes:
    """Encodes an image as PNG."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=_DPI)
    return buffer.getvalue()
