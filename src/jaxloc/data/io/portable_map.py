"""Gray and color images of the Netpbm formats P2, P3, P5 and P6, scaled by their largest value.

OpenCV takes the samples of binary files as they are; by the format's definition the largest value is white.

References:
    The Netpbm project, "PGM format specification", "PPM format specification".
"""

import re
from pathlib import Path

import numpy as np
from jaxtyping import UInt16

from jaxloc.data.io.errors import DataError

_BETWEEN = rb"(?:\s|#[^\n]*\n)+"
_HEADER = re.compile(rb"P([2356])" + 3 * (_BETWEEN + rb"(\d{1,9})") + rb"\s")
_WHITE = 65535


def is_portable_map(data: bytes) -> bool:
    """Whether a file is of these formats.

    Example:
        >>> is_portable_map(b"P5 1 1 255 x"), is_portable_map(b"P4 1 1 x")
        (True, False)
    """
    return data[:2] in (b"P2", b"P3", b"P5", b"P6")


def decode_portable_map(path: Path | str, data: bytes) -> UInt16[np.ndarray, "h w c"]:
    """Decodes an image.

    Args:
        path: the file, for errors.
        data: its content.

    Returns:
        Samples, 0 to 65535, of one or three channels (red, green, blue).

    Raises:
        DataError: when the header is damaged, or samples are missing.
    """
    match = _HEADER.match(data)
    if match is None:
        raise DataError(path, "is no image that can be read: its header is damaged")
    form, columns, rows, white = (int(group) for group in match.groups())
    channels = 3 if form in (3, 6) else 1
    count = rows * columns * channels
    if not (count and 0 < white <= _WHITE):
        raise DataError(path, f"is no image that can be read: {columns}x{rows} px, largest value {white}")
    values = _binary(data[match.end() :], white, count) if form > 3 else _plain(data[match.end() :], count)
    if values is None or len(values) < count:
        raise DataError(path, "is an image that cannot be read: it is truncated or damaged")
    scaled = np.minimum(values[:count], white).astype(np.uint32)
    scaled *= _WHITE
    scaled += white // 2
    scaled //= white
    return scaled.astype(np.uint16).reshape(rows, columns, channels)


def _binary(data: bytes, white: int, count: int) -> np.ndarray:
    dtype = np.dtype(np.uint8 if white < 256 else ">u2")
    return np.frombuffer(data[: len(data) // dtype.itemsize * dtype.itemsize], dtype)[:count]


def _plain(data: bytes, count: int) -> np.ndarray | None:
    if len(data) < 2 * count - 1:  # a digit and a space for each
        return None
    try:
        words = re.sub(rb"#[^\n]*", b"", data).split()[:count]
        return np.array([min(int(word), _WHITE) for word in words if word.isdigit() and len(word) < 10], np.int64)
    except ValueError:
        return None
