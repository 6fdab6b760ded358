"""Images of all formats that a camera or a map comes in, as 8-bit gray or color.

What OpenCV's ``imread`` does, but for: images of more than 8 bits whose values stay below 4096 come from a camera of
12 bits and are scaled by that; Netpbm files are scaled by their largest value; the size is known before it is decoded.
"""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Num, UInt8, UInt16

from jaxloc.data.io.errors import DataError
from jaxloc.data.io.files import read_bytes
from jaxloc.data.io.image_header import Header, parse_header
from jaxloc.data.io.portable_map import decode_portable_map, is_portable_map

SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".webp"})
_LARGEST = 1 << 29
# Pixels: an image may have this many, or so many for each of its bytes, and never more than the last.
_FREE_PIXELS, _PIXELS_PER_BYTE, _MOST_PIXELS = 25_000_000, 25, 400_000_000
_TWELVE_BITS = 4095


def read_gray(path: Path | str) -> UInt8[np.ndarray, "h w"]:
    """Reads an image as gray values, turned as its EXIF orientation says.

    Args:
        path: the file.

    Returns:
        Gray values, 0 to 255.

    Raises:
        DataError: when it is missing, damaged, too large, or of an unknown format.
    """
    return decode_gray(path, read_bytes(path, largest=_LARGEST, missing="no such image"))


def read_color(path: Path | str) -> UInt8[np.ndarray, "h w 3"]:
    """Reads an image in color, turned as its EXIF orientation says.

    Args:
        path: the file.

    Returns:
        Blue, green and red, 0 to 255.

    Raises:
        DataError: when it is missing, damaged, too large, or of an unknown format.
    """
    return decode_color(path, read_bytes(path, largest=_LARGEST, missing="no such image"))


def read_stored(path: Path | str) -> UInt8[np.ndarray, "h w c"] | UInt16[np.ndarray, "h w c"]:
    """Reads an image with all its channels, also transparency, and as it is stored.

    Args:
        path: the file.

    Returns:
        One to four channels: gray, or blue, green and red, and opacity; of 8 or 16 bits.

    Raises:
        DataError: when it is missing, damaged, too large, or of an unknown format.
    """
    data = read_bytes(path, largest=_LARGEST, missing="no such image")
    check_header(path, data)
    image = _decode(path, data, cv2.IMREAD_UNCHANGED)
    return image if image.ndim == 3 else image[..., None]


def read_orientation(path: Path | str) -> int:
    """Reads the EXIF orientation of an image.

    Args:
        path: the file.

    Returns:
        1 to 8; 1 where it is not given.

    Raises:
        DataError: as for `read_gray`.
    """
    return check_header(path, read_bytes(path, largest=_LARGEST, missing="no such image")).orientation


def decode_gray(path: Path | str, data: bytes) -> UInt8[np.ndarray, "h w"]:
    """`read_gray` of bytes that are there; the path is for errors."""
    check_header(path, data)
    return _to_8_bits(_decode(path, data, cv2.IMREAD_ANYDEPTH))  # without IMREAD_COLOR: gray


def decode_color(path: Path | str, data: bytes) -> UInt8[np.ndarray, "h w 3"]:
    """`read_color` of bytes that are there; the path is for errors."""
    check_header(path, data)
    return _to_8_bits(_decode(path, data, cv2.IMREAD_ANYDEPTH | cv2.IMREAD_COLOR))


def check_header(path: Path | str, data: bytes) -> Header:
    """Checks the size of an image before it is decoded.

    Args:
        path: the file, for errors.
        data: its content.

    Returns:
        Its header.

    Raises:
        DataError: when the format is unknown, or the image too large for its file.
    """
    header = parse_header(data)
    if header is None or header.rows < 1 or header.columns < 1:
        raise DataError(path, "is no image that can be read: png, jpg, bmp, tif, pgm, ppm and webp are")
    if header.bits > 16:
        raise DataError(path, f"is no image that can be read: it has {header.bits} bits, at most 16 can be")
    # An image of 16 bits needs as much memory as one of twice the size.
    check_pixels(path, header.rows * header.columns * (2 if header.bits > 8 else 1), len(data))
    return header


def check_pixels(path: Path | str, pixels: int, size: int) -> None:
    """Checks that an image is not too large to be decoded.

    Args:
        path: the file, for the error.
        pixels: that it declares.
        size: bytes of the file.

    Raises:
        DataError: when it is.
    """
    most = min(max(_FREE_PIXELS, _PIXELS_PER_BYTE * size), _MOST_PIXELS)
    if pixels > most:
        raise DataError(path, f"is an image of {pixels} px, too many for a file of {size} bytes: {most} can be")


def _decode(path: Path | str, data: bytes, flags: int) -> Num[np.ndarray, "h w *c"]:
    if is_portable_map(data):
        image = decode_portable_map(path, data)
        color, wanted = image.shape[2] == 3, bool(flags & cv2.IMREAD_COLOR) and flags != cv2.IMREAD_UNCHANGED
        image = np.ascontiguousarray(((image + 128.0) // 257).astype(np.uint8)[..., ::-1])
        if flags == cv2.IMREAD_UNCHANGED or color == wanted:
            return image if color else image[..., 0]
        return cv2.cvtColor(image, cv2.COLOR_GRAY2BGR if wanted else cv2.COLOR_BGR2GRAY)
    logging = cv2.utils.logging
    level = logging.setLogLevel(logging.LOG_LEVEL_SILENT)  # what OpenCV prints, DataError says better
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        image = None
    finally:
        logging.setLogLevel(level)
    if image is None or image.dtype not in (np.uint8, np.uint16) or not image.size:
        raise DataError(path, "is no image that can be read: it is damaged, or not of 8 or 16 bits")
    return image


def _to_8_bits(image: Num[np.ndarray, "h w *c"]) -> UInt8[np.ndarray, "h w *c"]:
    if image.dtype == np.uint8:
        return image
    white = _TWELVE_BITS if int(image.max()) <= _TWELVE_BITS else 65535
    return cv2.convertScaleAbs(image, alpha=255.0 / white)
