"""Pictures of moving objects: annotated frames, and the scene from above."""

import io
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Int

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
    """A frame with what moves in it.

    Args:
        image: gray image.
        points: moving points, px.
        boxes: (left, top, right, bottom) of measured objects, px.
        uv: where tracks are, px.
        labels: their numbers.
        speeds: m/s.
    """
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

    pixels = np.asarray(image)
    height, width = pixels.shape
    figure = Figure(figsize=(10.0, 10.0 * height / width + 0.3), layout="constrained")
    plot = figure.add_subplot()
    plot.imshow(pixels, cmap="gray", vmin=0, vmax=255)
    plot.plot(points[:, 0], points[:, 1], ".", color="#e8590c", markersize=3)
    for left, top, right, bottom in boxes:
        plot.add_patch(
            Rectangle((left - 4, top - 4), right - left + 8, bottom - top + 8, fill=False, color="#ffd43b", linewidth=1)
        )
    for (u, v), label, speed in zip(uv, labels, speeds, strict=True):
        plot.plot(u, v, "+", color="#4dabf7", markersize=10)
        plot.annotate(
            f"{label}: {speed:.1f} m/s", (u, v), xytext=(4, 10), textcoords="offset points", color="#4dabf7", fontsize=8
        )
    plot.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
    plot.set_axis_off()
    return figure


def draw_from_above(camera: Float[np.ndarray, "n 3"], paths: dict[int, Float[np.ndarray, "m 7"]]) -> "Figure":
    """Tracks and the path of the camera, seen from above (x right, z forward).

    Args:
        camera: positions of the camera, m.
        paths: by track number: frame, position and velocity.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 6.0), layout="constrained")
    plot = figure.add_subplot()
    plot.plot(camera[:, 0], camera[:, 2], color="black", label="camera")
    for index, (label, path) in enumerate(sorted(paths.items())):
        color = f"C{index % 10}"
        plot.plot(path[:, 1], path[:, 3], ".-", color=color, markersize=3, linewidth=1)
        plot.annotate(str(label), (path[-1, 1], path[-1, 3]), color=color, fontsize=8)
        x, z, along_x, along_z = path[-1, [1, 3, 4, 6]]
        plot.annotate(
            "", (x + 0.3 * along_x, z + 0.3 * along_z), (x, z), arrowprops={"arrowstyle": "->", "color": color}
        )
    plot.set(xlabel="x, m", ylabel="z, m")
    plot.set_aspect("equal", adjustable="datalim")
    plot.legend()
    plot.grid(alpha=0.3)
    return figure


def encode(figure: "Figure") -> bytes:
    """The picture as a PNG file."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=_DPI)
    return buffer.getvalue()
