"""Text files of numbers, with errors that name the file and the line."""

import array
import codecs
import io
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64

from jaxloc.data.io.errors import DataError
from jaxloc.data.io.files import open_unpacked

_BYTE_ORDER_MARKS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF32_LE, "utf-32"),  # begins with the mark of UTF-16
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
_LARGEST_TEXT = 1 << 28
_LONGEST_LINE = 1 << 20
_LARGEST_NUMBER = 1e30  # the square of twice as many digits would not fit into float32
_WHOLE = 2**53
_LATEST = 1e11  # s: the year 5138


def read_text(path: Path | str, *, largest: int = _LARGEST_TEXT) -> str:
    r"""Reads a text file: UTF-8, or by its byte order mark UTF-16 or UTF-32; plain, or packed with gzip or bzip2.

    Args:
        path: the file.
        largest: bytes that it may have, unpacked.

    Returns:
        Its text, with ``\n`` between the lines.

    Raises:
        DataError: when it is missing, unreadable, too large, or no text.
    """
    path = Path(path)
    with open_unpacked(path) as (file, limit):
        limit = min(limit, largest)
        content = file.read(limit + 1)
        if len(content) > limit:
            raise DataError(path, f"holds more than {limit / 2**20:.3g} MiB of text: too large for such a file")
    try:
        text = content.decode(_encoding(content))
    except UnicodeDecodeError as error:
        raise DataError(path, "is no text file") from error
    return text.replace("\r\n", "\n").replace("\r", "\n")


def read_lines(path: Path | str) -> Iterator[tuple[int, list[str]]]:
    """Reads a text file as `read_text` does, but line by line: for recordings that need not fit into memory.

    Args:
        path: the file.

    Yields:
        The number and the words of each line that is neither empty nor a ``#`` comment.

    Raises:
        DataError: when it is missing, damaged or too large.
    """
    path = Path(path)
    total, number = 0, 0
    with open_unpacked(path) as (file, limit):
        text = io.TextIOWrapper(file, encoding=_encoding(file.peek(4)), errors="replace", newline=None)
        while line := text.readline(_LONGEST_LINE):
            number, total = number + 1, total + len(line)
            if len(line) == _LONGEST_LINE:
                raise DataError(path, f"line {number} is longer than {_LONGEST_LINE} bytes")
            if total > limit:
                raise DataError(path, f"holds more than {limit / 2**20:.3g} MiB of text: too large for such a file")
            words = line.split()
            if words and not words[0].startswith("#"):
                yield number, words


def _encoding(content: bytes) -> str:
    return next((name for mark, name in _BYTE_ORDER_MARKS if content.startswith(mark)), "utf-8")


def parse_numbers(path: Path | str, line: int, words: list[str], count: int) -> list[float]:
    """Parses one line of finite numbers.

    Args:
        path: the file, for the error.
        line: the number of the line, counted from 1, for the error.
        words: the words of the line.
        count: how many numbers it must hold.

    Returns:
        The numbers.

    Raises:
        DataError: when there are more or fewer, or one is no finite number.
    """
    if len(words) != count:
        raise DataError(path, f"line {line} has {len(words)} numbers, needs {count}")
    values = parse_any_numbers(path, line, words)
    for value in values:
        if not -_LARGEST_NUMBER <= value <= _LARGEST_NUMBER:
            if np.isfinite(value):
                raise DataError(path, f"line {line} holds {value:g}, too large to compute with")
            raise DataError(path, f"line {line} holds a number that is not finite")
    return values


def parse_any_numbers(path: Path | str, line: int, words: Iterable[str]) -> list[float]:
    """Parses numbers that may be nan or infinite.

    Args:
        path: the file, for the error.
        line: the number of the line, counted from 1, for the error.
        words: the words of the line.

    Returns:
        The numbers.

    Raises:
        DataError: when one is no number.
    """
    try:
        values = [float(word) for word in words]
    except ValueError:
        raise DataError(path, f"line {line} holds something that is no number") from None
    if any("_" in word for word in words):  # Python's own notation, no other program's
        raise DataError(path, f"line {line} holds something that is no number")
    return values


def is_whole(value: float) -> bool:
    """Whether a number is a whole one that double precision holds exactly.

    Example:
        >>> is_whole(3.0), is_whole(0.5), is_whole(1e300), is_whole(float("nan"))
        (True, False, False, False)
    """
    return bool(abs(value) <= _WHOLE and value == int(value))


def whole_numbers(path: Path | str, values: Float64[np.ndarray, " n"], what: str) -> Int64[np.ndarray, " n"]:
    """A column of numbers that count or name something.

    Args:
        path: the file, for the error.
        values: a number for each row.
        what: what they number, for the error.

    Returns:
        The numbers as integers.

    Raises:
        DataError: when one is not whole.
    """
    wrong = [row for row, value in enumerate(values.tolist()) if not is_whole(value)]
    if wrong:
        raise DataError(path, f"row {wrong[0] + 1} has {values[wrong[0]]:g} as the number of a {what}")
    return values.astype(np.int64)


def is_positive(value: float) -> bool:
    """Whether a length is positive, and remains so in single precision.

    Example:
        >>> is_positive(0.05), is_positive(0.0), is_positive(1e-320), is_positive(float("inf"))
        (True, False, False, False)
    """
    return bool(1.0 / _LARGEST_NUMBER < value < _LARGEST_NUMBER)


def read_rows(path: Path | str, count: int) -> Float64[np.ndarray, "n count"]:
    """Reads a table of numbers separated by spaces or commas; empty lines and ``#`` comments are skipped.

    Args:
        path: the file.
        count: numbers in a row.

    Returns:
        The table, possibly with no rows.

    Raises:
        DataError: when the file is missing or a line is malformed.
    """
    table = array.array("d")  # a list of lists would need four times the memory
    for number, line in enumerate(read_text(path).split("\n"), start=1):
        words = line.split("#", 1)[0].replace(",", " ").split()
        if words:
            table.extend(parse_numbers(path, number, words, count))
    return np.array(table, dtype=np.float64).reshape(-1, count)


def check_increasing(path: Path | str, times: Float64[np.ndarray, " n"]) -> None:
    """Checks that stamps increase.

    Args:
        path: the file, for the error.
        times: s.

    Raises:
        DataError: when they do not, or are no seconds.
    """
    check_seconds(path, times)
    wrong = np.flatnonzero(np.diff(times) <= 0)
    if wrong.size:
        raise DataError(path, f"times do not increase: row {wrong[0] + 2} is not later than the row before it")


def check_seconds(path: Path | str, times: Float64[np.ndarray, " n"]) -> None:
    """Checks that stamps can be seconds: of this age, if they count from 1970.

    Args:
        path: the file, for the error.
        times: s.

    Raises:
        DataError: when they are larger, such as nanoseconds.
    """
    largest = float(np.abs(times).max(initial=0.0))
    if largest > _LATEST:
        raise DataError(path, f"has the time {largest:g}, which is no time in seconds: are these nanoseconds?")


def check_rotations(path: Path | str, matrices: Float64[np.ndarray, "n 4 4"], tolerance: float = 1e-3) -> None:
    """Checks that the upper left blocks are rotations, as far as the printed digits allow.

    Args:
        path: the file, for the error.
        matrices: poses.
        tolerance: largest deviation of ``R^T R`` from the identity.

    Raises:
        DataError: when one is not.
    """
    rotations = matrices[:, :3, :3]
    deviation = np.abs(np.swapaxes(rotations, 1, 2) @ rotations - np.eye(3)).max(axis=(1, 2))
    wrong = np.flatnonzero((deviation > tolerance) | (np.linalg.det(rotations) < 0))
    if wrong.size:
        raise DataError(path, f"row {wrong[0] + 1} is no pose: its 3x3 block is not a rotation")
