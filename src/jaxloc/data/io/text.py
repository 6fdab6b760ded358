"""Text files of numbers, with errors that name the file and the line."""

from pathlib import Path

import numpy as np
from jaxtyping import Float64

from jaxloc.data.io.errors import DataError


def read_text(path: Path | str) -> str:
    """Reads a text file.

    Args:
        path: the file.

    Returns:
        Its text.

    Raises:
        DataError: when it is missing, unreadable or no text.
    """
    path = Path(path)
    try:
        return path.read_text(encoding="utf-8-sig")
    except FileNotFoundError as error:
        raise DataError(path, "no such file") from error
    except OSError as error:
        raise DataError(path, f"cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise DataError(path, "is no text file") from error


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
    try:
        values = [float(word) for word in words]
    except ValueError:
        raise DataError(path, f"line {line} holds something that is no number") from None
    if not np.isfinite(values).all():
        raise DataError(path, f"line {line} holds a number that is not finite")
    return values


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
    rows = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        words = line.split("#", 1)[0].replace(",", " ").split()
        if words:
            rows.append(parse_numbers(path, number, words, count))
    return np.array(rows, dtype=np.float64).reshape(len(rows), count)


def check_increasing(path: Path | str, times: Float64[np.ndarray, " n"]) -> None:
    """Checks that stamps increase.

    Args:
        path: the file, for the error.
        times: s.

    Raises:
        DataError: when they do not.
    """
    wrong = np.flatnonzero(np.diff(times) <= 0)
    if wrong.size:
        raise DataError(path, f"times do not increase: row {wrong[0] + 2} is not later than the row before it")


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
