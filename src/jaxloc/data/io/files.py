"""Bytes of files, with bounds on what a small or special file can cost."""

import bz2
import gzip
import io
import re
import stat
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from jaxloc.data.io.errors import DataError

_LARGEST = 1 << 28
# Packed text of recordings is 2 to 15 times as long as the file; a crafted file can reach 1000.
_LARGEST_RATIO, _FREE_BYTES = 12, 1 << 23


def read_bytes(path: Path | str, *, largest: int = _LARGEST, missing: str = "no such file") -> bytes:
    """Reads a file.

    Args:
        path: the file.
        largest: bytes that it may have.
        missing: what the error says when it is not there.

    Returns:
        Its content.

    Raises:
        DataError: when it is missing, unreadable, too large, or no regular file.
    """
    path = Path(path)
    with open_file(path, missing=missing) as file:
        content = file.read(largest + 1)
    if len(content) > largest:
        raise DataError(path, f"is larger than {largest >> 20} MiB: too large for such a file")
    return content


@contextmanager
def open_file(path: Path | str, *, missing: str = "no such file") -> Iterator[BinaryIO]:
    """Opens a regular file for reading; pipes and devices, whose end may never come, are refused.

    Args:
        path: the file.
        missing: what the error says when it is not there.

    Yields:
        The open file.

    Raises:
        DataError: when it is missing, unreadable, or no regular file; also for errors while it is read.
    """
    path = Path(path)
    try:
        mode = path.stat().st_mode
        if stat.S_ISDIR(mode):
            raise DataError(path, "cannot be read: is no file but a folder")
        if not stat.S_ISREG(mode):
            raise DataError(path, "cannot be read: is no file but a pipe or a device")
        with path.open("rb") as file:
            yield file
    except FileNotFoundError as error:
        raise DataError(path, missing) from error
    except OSError as error:
        raise DataError(path, f"cannot be read: {error.strerror or 'damaged'}") from error
    except ValueError as error:
        if isinstance(error, DataError) or "null" not in str(error):
            raise
        raise DataError(path, "is no file name: it holds a NUL character") from error


@contextmanager
def open_unpacked(path: Path | str) -> Iterator[tuple[io.BufferedReader, int]]:
    """Opens a file that may be packed with gzip or bzip2; its first bytes tell.

    Args:
        path: the file.

    Yields:
        The unpacked file, and how many bytes may be read from it.

    Raises:
        DataError: as `open_file`, and when it is damaged.
    """
    path = Path(path)
    with open_file(path) as file:
        magic = file.read(3)
        size = file.seek(0, io.SEEK_END)
        file.seek(0)
        unpack = gzip.open if magic[:2] == b"\x1f\x8b" else bz2.open if magic == b"BZh" else None
        if unpack is None:
            yield io.BufferedReader(file), 1 << 31  # pyright: ignore[reportArgumentType]
            return
        try:
            with unpack(file, "rb") as unpacked:
                limit = max(_FREE_BYTES, _LARGEST_RATIO * size)
                yield io.BufferedReader(unpacked), limit  # pyright: ignore[reportArgumentType]
        except (OSError, EOFError, zlib.error) as error:
            raise DataError(path, "cannot be read: it cannot be unpacked, is damaged or truncated") from error


def is_folder(path: Path) -> bool:
    """Whether a path is a folder; a name that no file can have is none."""
    try:
        return path.is_dir()
    except (OSError, ValueError):
        return False


def exists(path: Path) -> bool:
    """Whether there is something of this name; of a name that no file can have, there is nothing."""
    try:
        return path.exists()
    except (OSError, ValueError):
        return False


def natural_order(path: Path) -> list[tuple[int, int, str]]:
    """Key that sorts names with numbers in them by these numbers: 9 before 10.

    Example:
        >>> [path.name for path in sorted(map(Path, ("f10", "f9", "f²")), key=natural_order)]
        ['f9', 'f10', 'f²']
    """
    parts = re.split(r"(\d+)", path.name.lower())
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts]
