"""Images annotated with the lane, as files or as a video."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from jaxloc.data import DataError
from jaxloc.data.io.writing import write_file
from jaxloc.data.road_images import LaneFrame, LaneRecording
from jaxloc.features.opencv.backend import load

_MEASURED, _PREDICTED, _WARNING = (80, 200, 0), (0, 140, 255), (0, 0, 255)  # blue, green, red
_WARN = 1.0  # s before a line is crossed


def annotate(color: UInt8[np.ndarray, "h w 3"], output: Any) -> UInt8[np.ndarray, "h w 3"]:
    """Draws the borders of the lane and writes its numbers.

    Args:
        color: the image, in OpenCV's order of colors.
        output: output of the pipeline; predicted borders are orange, one that is about to be crossed is red.

    Returns:
        A new image.
    """
    cv2 = load()
    image = color.copy()
    thick = max(1, color.shape[1] // 400)
    for side, columns in ((1, output.left), (-1, output.right)):
        shade = _MEASURED if output.ok else _PREDICTED
        if output.ok and output.crossing < _WARN and output.crossing_side == side:
            shade = _WARNING
        points = np.clip(np.stack([columns, output.rows], axis=1), -3e4, 3e4)
        cv2.polylines(image, [np.rint(points * 8).astype(np.int32)[:, None]], False, shade, thick, cv2.LINE_AA, 3)
    offset, heading, curvature, _ = output.lane
    text = f"{offset:+.2f} m  {1e3 * heading:+.1f} mrad  {1e3 * curvature:+.2f} /km"
    text = f"{text}  {output.confidence:.2f} {output.source}"
    size = color.shape[1] / 1400.0
    place = (int(20 * size) + 2, int(36 * size) + 8)
    for shade, width in (((0, 0, 0), 3 * thick), ((255, 255, 255), thick)):
        cv2.putText(image, text, place, cv2.FONT_HERSHEY_SIMPLEX, max(size, 0.3), shade, width, cv2.LINE_AA)
    return image


@contextmanager
def open_gallery(recording: LaneRecording, out: Path) -> Iterator[Callable[[LaneFrame, np.ndarray], None]]:
    """Opens the destination of annotated images: a video for a video, a folder of images for images.

    Args:
        recording: the images.
        out: folder for the results.

    Yields:
        A function of a frame and its annotated image.

    Raises:
        DataError: when they cannot be written.
    """
    if recording.rate is None:
        folder = out / "images"
        folder.mkdir(exist_ok=True)
        yield lambda frame, image: _write_image(folder / f"{Path(frame.name).stem}.jpg", image)
        return
    cv2 = load()
    path = out / "annotated.mp4"
    video = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), recording.rate, recording.shape[::-1])
    try:
        if not video.isOpened():
            raise DataError(path, "cannot be written: this OpenCV has no MPEG-4 encoder")
        yield lambda frame, image: video.write(image)
    finally:
        video.release()


def _write_image(path: Path, image: UInt8[np.ndarray, "h w 3"]) -> None:
    done, data = load().imencode(".jpg", image)
    if not done:
        raise DataError(path, "cannot be encoded")
    write_file(path, data.tobytes())
