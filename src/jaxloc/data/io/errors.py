"""Exception raised by readers and writers."""

from pathlib import Path

_LONGEST = 400


def _one_line(text: str) -> str:
    """Text with spaces for line ends, and codes for characters that a terminal would act on."""
    plain = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)
    return plain if len(plain) <= _LONGEST else f"{plain[:_LONGEST]}..."


class DataError(ValueError):
    """Unusable input: a one-line message that names the file and the fault.

    Args:
        path: the file or folder at fault.
        what: what is wrong, and what is needed instead.

    Example:
        >>> print(DataError("calib.txt", "has no line P1:"))
        calib.txt: has no line P1:
    """

    def __init__(self, path: Path | str, what: str):
        self.path = Path(path)
        self.what = _one_line(" ".join(what.splitlines()))
        super().__init__(f"{_one_line(str(path))}: {self.what}")
