"""Grayscale PNG images, verified by their checksums.

OpenCV returns a partly gray image for a truncated PNG, silently. Here the chunks are walked first: their lengths must
lead to the end chunk, and their checksums must be right (PNG specification, ISO/IEC 15948, section 5.3).
"""

import zlib
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from jaxloc.data.io.errors import DataError
from jaxloc.data.io.files import open_file, read_bytes
from jaxloc.data.io.images import check_pixels, decode_gray

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_END = b"\x00\x00\x00\x00IEND\xaeB`\x82"
_HEADER_LENGTH = 33


def _read(path: Path) -> bytes:
    return read_bytes(path, missing="no such image")


def read_size(path: Path | str) -> tuple[int, int]:
    """Reads the size of a PNG image without decoding it, and checks that the file has its end.

    Args:
        path: the image.

    Returns:
        Height and width, px.

    Raises:
        DataError: when it is missing, no PNG, or cut short.
    """
    path = Path(path)
    with open_file(path, missing="no such image") as file:
        head = file.read(_HEADER_LENGTH)
        size = file.seek(0, 2)
        file.seek(max(size - len(_END), 0))
        tail = file.read()
    _check_signature(path, head)
    if len(head) < _HEADER_LENGTH or tail != _END:
        raise DataError(path, "truncated PNG image")
    rows, columns = int.from_bytes(head[20:24], "big"), int.from_bytes(head[16:20], "big")
    check_pixels(path, rows * columns, size)
    return rows, columns


def _check_signature(path: Path, data: bytes) -> None:
    if not data:
        raise DataError(path, "empty file, not a PNG image")
    if not data.startswith(_SIGNATURE[: len(data)]) or data[12:16] not in (b"IHDR", b""):
        raise DataError(path, "not a PNG image")


def _check_chunks(path: Path, data: bytes) -> None:
    _check_signature(path, data)
    position, kind, view = len(_SIGNATURE), b"", memoryview(data)
    while kind != b"IEND":
        length = int.from_bytes(data[position : position + 4], "big")
        end = position + 12 + length
        if end > len(data) or position + 12 > len(data):
            raise DataError(path, "truncated PNG image")
        kind = data[position + 4 : position + 8]
        if zlib.crc32(view[position + 4 : end - 4]) != int.from_bytes(data[end - 4 : end], "big"):
            raise DataError(path, "damaged PNG image: a checksum is wrong")
        position = end


def verify_image(path: Path | str) -> None:
    """Checks every byte of a PNG image against its checksums, without decoding it.

    Args:
        path: the image.

    Raises:
        DataError: when it is missing, no PNG, cut short or damaged.
    """
    path = Path(path)
    _check_chunks(path, _read(path))


def read_image(path: Path | str) -> UInt8[np.ndarray, "h w"]:
    """Reads a PNG image as gray values; color is converted.

    Args:
        path: the image.

    Returns:
        Gray values, 0 to 255.

    Raises:
        DataError: when it is missing, no PNG, cut short or damaged.
    """
    path = Path(path)
    data = _read(path)
    _check_chunks(path, data)
    return decode_gray(path, data)
