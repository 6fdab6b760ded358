"""Exception raised by readers and writers."""

from pathlib import Path


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
        super().__init__(f"{path}: {what}")
        self.path = Path(path)
        self.what = what
