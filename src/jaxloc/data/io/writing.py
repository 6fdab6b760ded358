"""Atomic writing of files.

Everything is written beside its place under a temporary name and moved there in one step, so that a reader never
sees half a file and a failed run leaves the files of the run before it.
"""

import contextlib
import os
from pathlib import Path
from types import TracebackType
from typing import TextIO

from jaxloc.data.io.errors import DataError


def _temporary(path: Path) -> Path:
    return path.with_name(f".{path.name}.{os.getpid()}.partial")


def write_file(path: Path | str, content: str | bytes) -> None:
    """Writes a file in one step, over one that may be there.

    Args:
        path: the file.
        content: text (written as UTF-8) or bytes.

    Raises:
        DataError: when the file cannot be written.

    Example:
        >>> import tempfile
        >>> from pathlib import Path
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_file(Path(folder) / "a.txt", "one")
        ...     (Path(folder) / "a.txt").read_text()
        'one'
    """
    path = Path(path)
    temporary = _temporary(path)
    try:
        # Names of files that are not UTF-8 hold what cannot be encoded.
        data = content.encode(errors="backslashreplace") if isinstance(content, str) else content
        temporary.write_bytes(data)
        os.replace(temporary, path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise DataError(path, f"cannot be written: {error.strerror}") from error


class RowWriter:
    r"""Text file written row by row, renamed to its final name when its block ends.

    An interrupt (Ctrl-C, or the end of the program) keeps the rows written so far, if there are any; any other error
    throws them away and leaves the file that was there before.

    Args:
        path: the file.
        header: its first line or lines, without the last line end.

    Raises:
        DataError: when the file cannot be written.

    Example:
        >>> import tempfile
        >>> from pathlib import Path
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     with RowWriter(Path(folder) / "a.csv", header="frame") as rows:
        ...         rows.append("0")
        ...     (Path(folder) / "a.csv").read_text()
        'frame\n0\n'
    """

    def __init__(self, path: Path | str, header: str | None = None):
        self.path = Path(path)
        self._header = header
        self._file: TextIO | None = None
        self._rows = 0

    def __enter__(self) -> "RowWriter":
        try:
            self._file = _temporary(self.path).open("w", encoding="utf-8", errors="backslashreplace", newline="\n")
        except OSError as error:
            raise DataError(self.path, f"cannot be written: {error.strerror}") from error
        if self._header is not None:
            try:
                self._write(self._header)
            except DataError:
                self._discard()
                raise
        return self

    def append(self, row: str) -> None:
        """Adds a row; it is in the file when this returns."""
        if self._file is None:
            raise ValueError(f"{self.path} is not open: append rows inside the writer's with block.")
        self._write(row)
        self._rows += 1

    def _write(self, line: str) -> None:
        assert self._file is not None
        try:
            self._file.write(f"{line}\n")
            self._file.flush()
        except OSError as error:
            raise DataError(self.path, f"cannot be written: {error.strerror}") from error

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None and not (self._rows and issubclass(kind, KeyboardInterrupt | SystemExit | GeneratorExit)):
            self._discard()
            return
        try:
            if self._file is not None:
                self._file.close()
            os.replace(_temporary(self.path), self.path)
        except OSError as failure:
            self._discard()
            raise DataError(self.path, f"cannot be written: {failure.strerror}") from failure
        self._file = None

    def _discard(self) -> None:
        if self._file is not None:
            with contextlib.suppress(OSError):  # what is still to be written does not fit on a full disk
                self._file.close()
            self._file = None
        _temporary(self.path).unlink(missing_ok=True)
