"""Command line: each command runs a pipeline on files and writes results and a report.

Bad input ends with one line on stderr, ``jaxloc: error: <file>: <what>``, and exit code 2; SIGINT (Ctrl-C) with 130,
SIGTERM with 143.
"""

import os
import signal
import sys
from types import FrameType

__all__ = ["main", "run"]

_BAD_INPUT, _INTERRUPTED = 2, 130
_FEWEST_THREADS = 8


def main() -> None:
    """Runs the command line and leaves the process with its exit code."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _leave)
    # Names of files that are not UTF-8 can be printed, too.
    for stream in (sys.stdout, sys.stderr):
        stream.reconfigure(errors="backslashreplace")  # pyright: ignore[reportAttributeAccessIssue]
    # With as few threads as cores, batched calls of LAPACK can wait for each other (docs/lapack_deadlock.md).
    os.environ.setdefault("PJRT_NPROC", str(max(_FEWEST_THREADS, os.cpu_count() or 1)))
    code = run(sys.argv[1:])
    sys.stdout.flush()
    sys.exit(code)


def run(arguments: list[str]) -> int:
    """Runs a command.

    Args:
        arguments: what follows ``jaxloc``.

    Returns:
        The exit code: 0, 2 after bad input, 130 or 143 after an interrupt.
    """
    try:
        from jaxloc.cli.app import app
    except ImportError as error:
        return _fail(f'the command line needs {error.name}: pip install "jaxloc[cli]"')
    try:
        return int(app(args=arguments or ["--help"], prog_name="jaxloc", standalone_mode=False) or 0)
    except KeyboardInterrupt:
        return _INTERRUPTED
    except SystemExit as interrupt:
        return int(interrupt.code or 0)
    except BrokenPipeError:
        # The reader of the output closed it, as `head` does: print nothing more.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except Exception as error:
        if type(error).__name__ == "Abort":
            return _INTERRUPTED
        message = _describe(error)
        if message is None:
            raise
        return _fail(message)


def _leave(number: int, frame: FrameType | None) -> None:
    """Ends the process where nothing is being written: an exception can get lost in a callback of a library."""
    print("jaxloc: interrupted", file=sys.stderr, flush=True)
    os._exit(128 + number)


def _describe(error: Exception) -> str | None:
    """The line that explains bad input, or None when the error is a bug."""
    if hasattr(error, "format_message"):  # an argument that the command line parser refused
        return error.format_message()
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    if isinstance(error, ImportError) and "pip install" in str(error):
        return str(error)
    from jaxloc.data import DataError

    return str(error) if isinstance(error, DataError) else None


def _fail(message: str) -> int:
    print(f"jaxloc: error: {' '.join(message.split())}", file=sys.stderr)
    return _BAD_INPUT
