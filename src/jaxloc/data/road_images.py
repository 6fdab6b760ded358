"""Road images from a file, a folder or a video, frame by frame.

Host code: frames are decoded on demand.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float32, UInt8

from jaxloc.data.io.errors import DataError
from jaxloc.data.io.files import exists, natural_order, read_bytes
from jaxloc.data.io.images import SUFFIXES, check_header, check_pixels, decode_color
from jaxloc.features.opencv.backend import load

_VIDEOS = frozenset({".mp4", ".avi", ".mov", ".mkv", ".m4v", ".webm", ".mpg", ".mpeg", ".wmv"})


class LaneFrame(eqx.Module):
    """One image of the road.

    Args:
        index: number of the frame, from 0.
        name: of its file, or of the video with the number of the frame.
        time: s since the first frame, by the video's clock; None for images, which have none.
        gray: mean of red and green, 0 to 255: yellow paint is as bright as white then.
        color: the original, in OpenCV's order blue, green, red.
    """

    index: int
    name: str
    time: float | None
    gray: Float32[np.ndarray, "h w"]
    color: UInt8[np.ndarray, "h w 3"]


class LaneRecording(eqx.Module):
    """Images of the road in the order in which they were taken.

    Iterating decodes them, from the first one every time.

    Args:
        path: what was opened.
        files: the images, or the one video.
        rate: frames a second of a video; None for images.
        shape: rows and columns.
        count: frames; as declared by a video, which may be more than can be decoded.
        orientation: EXIF orientation of the images, which are turned by it.
    """

    path: Path
    files: tuple[Path, ...]
    rate: float | None
    shape: tuple[int, int]
    count: int
    orientation: int = 1

    def __len__(self) -> int:
        return self.count

    @property
    def is_video(self) -> bool:
        """Whether it is a video."""
        return self.rate is not None

    def __iter__(self) -> Iterator[LaneFrame]:
        if self.rate is not None:
            return self._video_frames(self.rate)
        return (self._image_frame(index, path) for index, path in enumerate(self.files))

    def _image_frame(self, index: int, path: Path) -> LaneFrame:
        color, orientation = _read_image(path)
        if orientation != self.orientation:
            ways = f"has the EXIF orientation {orientation}, but the first image {self.orientation}"
            raise DataError(path, f"{ways}: one camera cannot have both; turn the images or remove the tags")
        if color.shape[:2] != self.shape:
            raise DataError(path, f"is {_size(color.shape)}, but the first image is {_size(self.shape)}")
        return LaneFrame(index, path.name, None, _gray(color), color)

    def _video_frames(self, rate: float) -> Iterator[LaneFrame]:
        with _open_video(self.path) as video:
            index = 0
            while True:
                found, color = video.read()
                if not found:
                    return
                if color.shape[:2] != self.shape:
                    raise DataError(self.path, f"frame {index} is {_size(color.shape)}, not {_size(self.shape)}")
                yield LaneFrame(index, f"{self.path.name}:{index}", index / rate, _gray(color), color)
                index += 1


def open_recording(path: Path | str) -> LaneRecording:
    """Opens road images; the first one is decoded as a check.

    Args:
        path: an image, a video, or a folder of images (in the natural order of their names: 9 before 10).

    Returns:
        The recording.

    Raises:
        DataError: when there is nothing, or nothing that can be decoded.

    Example:
        >>> import tempfile, cv2, numpy as np
        >>> from pathlib import Path
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     written = [cv2.imwrite(f"{folder}/{i}.png", np.full((4, 6), i, np.uint8)) for i in (9, 10)]
        ...     frames = list(open_recording(folder))
        >>> [frame.name for frame in frames], frames[0].gray.shape
        (['9.png', '10.png'], (4, 6))
    """
    path = Path(path)
    if not exists(path):
        raise DataError(path, "no such file or folder")
    if path.is_file() and path.suffix.lower() in _VIDEOS:
        return _probe_video(path)
    files = _image_files(path) if path.is_dir() else (path,)
    if not files:
        raise DataError(path, "has no images: png, jpg, bmp, tif, pgm, ppm and webp are read")
    color, orientation = _read_image(files[0])
    return LaneRecording(path, files, None, color.shape[:2], len(files), orientation)


def _read_image(path: Path) -> tuple[UInt8[np.ndarray, "h w 3"], int]:
    """Colors, and the EXIF orientation by which they are turned."""
    data = read_bytes(path, missing="no such image")
    return decode_color(path, data), check_header(path, data).orientation


def _image_files(folder: Path) -> tuple[Path, ...]:
    found = [path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES and path.is_file()]
    return tuple(sorted(found, key=natural_order))


def _probe_video(path: Path) -> LaneRecording:
    cv2 = load()
    with _open_video(path) as video:
        sides = [video.get(prop) for prop in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)]
        check_pixels(path, int(sides[0] * sides[1]), path.stat().st_size)
        found, color = video.read()
        if not found:
            raise DataError(path, "is a video of which no frame can be decoded")
        rate, count = video.get(cv2.CAP_PROP_FPS), video.get(cv2.CAP_PROP_FRAME_COUNT)
    rate = float(rate) if np.isfinite(rate) and rate > 0.0 else 25.0
    return LaneRecording(path, (path,), rate, color.shape[:2], max(int(count), 1))


@contextmanager
def _open_video(path: Path) -> Iterator[Any]:
    # Decoders write to the terminal what DataError says better; OpenCV reads this when it opens a file.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    cv2 = load()
    with _quiet(cv2):
        video = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    try:
        if not video.isOpened():
            raise DataError(path, "is no video that can be decoded")
        yield video
    finally:
        video.release()


@contextmanager
def _quiet(cv2: ModuleType) -> Iterator[None]:
    """Keeps OpenCV's own warnings from the terminal."""
    logging = cv2.utils.logging
    level = logging.setLogLevel(logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        logging.setLogLevel(level)


def _gray(color: UInt8[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w"]:
    total = color[..., 1].astype(np.float32)  # in place: large images are large
    total += color[..., 2]
    total *= 0.5
    return total


def _size(shape: tuple[int, ...]) -> str:
    return f"{shape[1]}x{shape[0]}"
