"""Size, depth and orientation of an image from its first bytes: what decoding it would cost, before it is decoded.

The EXIF orientation (CIPA DC-008, tag 274) says how the rows and columns are to be turned for display: 1 as stored,
3 by half a turn, 6 and 8 by quarter turns, 2, 4, 5 and 7 mirrored.
"""

import re
import struct
from collections.abc import Iterator
from typing import NamedTuple

_PNG = b"\x89PNG\r\n\x1a\n"
_ORIENTATION = 274
_PNM = re.compile(rb"P([1-6])(?:\s|#[^\n]*\n)+(\d{1,9})(?:\s|#[^\n]*\n)+(\d{1,9})(?=\s)")
_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # JPEG markers that begin a frame


class Header(NamedTuple):
    """What the first bytes of an image say.

    Attributes:
        kind: png, jpeg, bmp, tiff, webp or pnm.
        rows: px.
        columns: px.
        orientation: of EXIF, 1 to 8; 1 where it is not given.
        bits: of a sample.
    """

    kind: str
    rows: int
    columns: int
    orientation: int = 1
    bits: int = 8


def parse_header(data: bytes) -> Header | None:
    """Reads the header of an image.

    Args:
        data: the file.

    Returns:
        The header; None where the format is unknown, or the header damaged.

    Example:
        >>> parse_header(b"P5 640 480 255 ")
        Header(kind='pnm', rows=480, columns=640, orientation=1, bits=8)
    """
    try:
        for begins, parse in _PARSERS:
            if data.startswith(begins):
                return parse(data)
    except (struct.error, IndexError, KeyError, ValueError):
        pass
    return None


def _png(data: bytes) -> Header:
    columns, rows, bits = struct.unpack(">IIB", data[16:25])
    orientation, position = 1, 8
    while position + 8 <= len(data):
        length, kind = struct.unpack(">I4s", data[position : position + 8])
        if kind == b"eXIf":
            orientation = _orientation(data[position + 8 : position + 8 + length])
        if kind == b"IDAT" and orientation != 1:
            break
        position += 12 + length
    return Header("png", rows, columns, orientation, bits)


def _jpeg(data: bytes) -> Header | None:
    orientation = 1
    for marker, start, end in _segments(data):
        if marker == 0xE1 and data[start : start + 6] == b"Exif\0\0":
            orientation = _orientation(data[start + 6 : end])
        if marker in _FRAMES:
            bits, rows, columns = struct.unpack(">BHH", data[start : start + 5])
            return Header("jpeg", rows, columns, orientation, bits)
    return None


def _segments(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Markers of a JPEG file with the places of what they hold, up to the first that is out of place."""
    position = 2
    while position + 4 <= len(data) and data[position] == 0xFF:
        marker = data[position + 1]
        if marker == 0xFF:  # a fill byte
            position += 1
            continue
        length = struct.unpack(">H", data[position + 2 : position + 4])[0]
        yield marker, position + 4, position + 2 + length
        position += 2 + length


def _bmp(data: bytes) -> Header:
    size = struct.unpack("<I", data[14:18])[0]
    columns, rows = struct.unpack("<HH", data[18:22]) if size == 12 else struct.unpack("<ii", data[18:26])
    return Header("bmp", abs(rows), abs(columns))


def _tiff(data: bytes) -> Header:
    tags = _tags(data)
    return Header("tiff", tags[257], tags[256], _valid(tags.get(_ORIENTATION, 1)), tags.get(258, 1))


def _webp(data: bytes) -> Header:
    kind, orientation = data[12:16], 1
    if kind == b"VP8X":
        columns, rows = (1 + int.from_bytes(data[i : i + 3], "little") for i in (24, 27))
        place = data.rfind(b"EXIF")
        if place > 0:
            orientation = _orientation(data[place + 8 :].removeprefix(b"Exif\0\0"))
    elif kind == b"VP8L":
        packed = int.from_bytes(data[21:25], "little")
        columns, rows = 1 + (packed & 0x3FFF), 1 + (packed >> 14 & 0x3FFF)
    else:
        columns, rows = (size & 0x3FFF for size in struct.unpack("<HH", data[26:30]))
    return Header("webp", rows, columns, orientation)


def _pnm(data: bytes) -> Header | None:
    match = _PNM.match(data[:4096])
    return None if match is None else Header("pnm", int(match[3]), int(match[2]))


def _orientation(exif: bytes) -> int:
    try:
        return _valid(_tags(exif).get(_ORIENTATION, 1))
    except struct.error:
        return 1


def _valid(orientation: int) -> int:
    return orientation if 1 <= orientation <= 8 else 1


def _tags(data: bytes) -> dict[int, int]:
    """First values of the whole-numbered tags in the first directory of a TIFF file or an EXIF block."""
    order = "<" if data[:2] == b"II" else ">"
    place = struct.unpack(f"{order}I", data[4:8])[0]
    count = struct.unpack(f"{order}H", data[place : place + 2])[0]
    found = {}
    for entry in range(place + 2, place + 2 + 12 * count, 12):
        tag, kind, number = struct.unpack(f"{order}HHI", data[entry : entry + 8])
        if kind not in (3, 4):
            continue
        start, width = entry + 8, 2 if kind == 3 else 4
        if width * number > 4:
            start = struct.unpack(f"{order}I", data[start : start + 4])[0]
        found[tag] = struct.unpack(f"{order}{'H' if kind == 3 else 'I'}", data[start : start + width])[0]
    return found


_PARSERS = (
    (_PNG, _png),
    (b"\xff\xd8\xff", _jpeg),
    (b"BM", _bmp),
    (b"II*\0", _tiff),
    (b"MM\0*", _tiff),
    (b"RIFF", _webp),
    (b"P", _pnm),
)
