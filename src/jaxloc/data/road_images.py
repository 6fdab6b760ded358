"""Road images from a file, a folder or a video, frame by frame.

Host code: frames are decoded on demand.
"""

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float32, UInt8

from jaxloc.data.io.errors import DataError
from jaxloc.features.opencv.backend import load

_IMAGES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".webp"})
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
    """

    path: Path
    files: tuple[Path, ...]
    rate: float | None
    shape: tuple[int, int]
    count: int

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
        color = _read_image(path)
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
    if not path.exists():
        raise DataError(path, "no such file or folder")
    if path.is_file() and path.suffix.lower() in _VIDEOS:
        return _probe_video(path)
    files = _image_files(path) if path.is_dir() else (path,)
    if not files:
        raise DataError(path, "has no images: png, jpg, bmp, tif, pgm, ppm and webp are read")
    shape = _read_image(files[0]).shape[:2]
    return LaneRecording(path, files, None, shape, len(files))


def _image_files(folder: Path) -> tuple[Path, ...]:
    found = [path for path in folder.iterdir() if path.suffix.lower() in _IMAGES and path.is_file()]
    return tuple(sorted(found, key=lambda path: _natural(path.name)))


def _natural(name: str) -> list[tuple[int, int, str]]:
    """Numbers in a name count as numbers."""
    parts = re.split(r"(\d+)", name.lower())
    return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in parts]


def _read_image(path: Path) -> UInt8[np.ndarray, "h w 3"]:
    cv2 = load()
    try:
        data = np.fromfile(path, np.uint8)
    except OSError as error:
        raise DataError(path, f"cannot be read: {error.strerror}") from error
    with _quiet(cv2):
        color = cv2.imdecode(data, cv2.IMREAD_COLOR) if data.size else None
    if color is None:
        raise DataError(path, "is no image that can be read")
    return color


def _probe_video(path: Path) -> LaneRecording:
    cv2 = load()
    with _open_video(path) as video:
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
    return 0.5 * (color[..., 1].astype(np.float32) + color[..., 2])


def _size(shape: tuple[int, ...]) -> str:
    return f"{shape[1]}x{shape[0]}"
