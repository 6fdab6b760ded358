"""Progress bar, orderly end on SIGINT and SIGTERM, compilation cache, and output folder of a run."""

import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any

from jaxloc.data import DataError


class Interruption:
    """Turns a first SIGINT (Ctrl-C) or SIGTERM into a request to stop after the current frame; a second stops at once.

    Attributes:
        number: of the signal; None before it.
    """

    def __init__(self) -> None:
        self.number: int | None = None
        self._previous: dict[int, Any] = {}

    @property
    def requested(self) -> bool:
        """Whether the run is to end."""
        return self.number is not None

    @property
    def code(self) -> int:
        """The exit code: 128 and the number of the signal, as shells have it; 0 without one."""
        return 0 if self.number is None else 128 + self.number

    def __enter__(self) -> "Interruption":
        try:
            for number in (signal.SIGINT, signal.SIGTERM):
                self._previous[number] = signal.signal(number, self._request)
        except ValueError:  # not in the main thread: signals go elsewhere
            self._previous.clear()
        return self

    def _request(self, number: int, frame: FrameType | None) -> None:
        if self.requested:
            raise SystemExit(128 + number)
        self.number = number

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)


@contextmanager
def show_progress(title: str, total: int) -> Iterator[Callable[[int], None]]:
    """Shows a progress bar on stderr while its block runs.

    Args:
        title: of the bar.
        total: number of items.

    Yields:
        A function to be called with the number of items done.
    """
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(title, total=total)
        yield lambda done: bar.update(task, completed=done)


@contextmanager
def output_folder(path: Path) -> Iterator[Path]:
    """Makes the folder for the results; one that was made here and is still empty after an error is removed.

    Args:
        path: the folder.

    Yields:
        The folder.

    Raises:
        DataError: when it cannot be made or written to.
    """
    check_output(path)
    made = [folder for folder in (path, *path.parents) if not folder.exists()]
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(path, f"cannot be made: {error.strerror}") from error
    try:
        yield path
    finally:
        for folder in made:
            if any(folder.iterdir()):
                break
            folder.rmdir()


def check_output(path: Path) -> None:
    """Checks that results can be written, without writing anything.

    Args:
        path: the folder for the results.

    Raises:
        DataError: when it, or what it is to be made in, is no folder that can be written to.
    """
    nearest = next(folder for folder in (path, *path.absolute().parents) if folder.exists())
    if not nearest.is_dir():
        raise DataError(nearest, "is a file, but the results need a folder")
    if not os.access(nearest, os.W_OK | os.X_OK):
        raise DataError(nearest, "cannot be written to")


def keep_compilations() -> None:
    """Keeps compiled programs in the user's cache folder, unless JAX_COMPILATION_CACHE_DIR names another."""
    import jax

    if "JAX_COMPILATION_CACHE_DIR" in os.environ or jax.config.jax_compilation_cache_dir:
        return
    home = Path.home()
    if sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA", home / "AppData" / "Local"))
    elif sys.platform == "darwin":
        base = home / "Library" / "Caches"
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME") or home / ".cache")
    jax.config.update("jax_compilation_cache_dir", str(base / "jaxloc" / "compiled"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
