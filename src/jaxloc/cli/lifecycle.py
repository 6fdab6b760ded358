"""Life cycle of a command: checks, output folder, rows as they come, interruption, results, and one line at the end."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import typer

from jaxloc.cli import options, results, session
from jaxloc.data import DataError
from jaxloc.data.io.writing import RowWriter


class Arguments(NamedTuple):
    """Arguments that every command has.

    Attributes:
        out: folder for the results; made if it is not there.
        config: YAML file with options; None for the defaults.
        settings: options as ``name=value``, applied after the file.
    """

    out: Path
    config: Path | None = None
    settings: tuple[str, ...] = ()

    def read(self, default: Any) -> Any:
        """The options of the command over the default ones.

        Raises:
            DataError: see `options.read_options`.
        """
        return options.read_options(default, self.config, self.settings)


def prepare(out: Path) -> None:
    """Checks all that can fail before any input is read: the output folder, and the libraries for the results.

    Args:
        out: folder for the results.

    Raises:
        DataError: when the folder cannot be used.
        ImportError: when a library is not there.
    """
    session.check_output(out)
    results.check_extras()
    options.check_extras()
    session.keep_compilations()


class Run:
    """A run of a command, from its first output to its exit code. Made by `open_run`.

    Args:
        out: folder for the results.
        interruption: whether SIGINT (Ctrl-C) or SIGTERM came.
    """

    def __init__(self, out: Path, interruption: session.Interruption):
        self.out, self._interruption = out, interruption

    @property
    def interrupted(self) -> bool:
        """Whether the run is to end early."""
        return self._interruption.requested

    def stream(
        self,
        outputs: Iterable[Any],
        write: Callable[[Any, Mapping[str, RowWriter]], None],
        *,
        title: str,
        total: int,
        files: Mapping[str, str | None] | None = None,
    ) -> None:
        """Takes the outputs of a pipeline one by one, until their end or an interrupt, with a progress bar.

        Args:
            outputs: of the pipeline.
            write: called with each output and the writers of the files.
            title: of the progress bar.
            total: number of outputs expected.
            files: names of tables in the output folder, with their headers.

        Raises:
            DataError: there is no output.
            SystemExit: interrupted before the first output; nothing is left behind.
        """
        count = 0
        with ExitStack() as stack:
            headers = {} if files is None else files
            rows = {name: stack.enter_context(RowWriter(self.out / name, header)) for name, header in headers.items()}
            progress = stack.enter_context(session.show_progress(title, total))
            for count, output in enumerate(outputs, start=1):
                write(output, rows)
                progress(count)
                if self.interrupted:
                    break
            if not count:
                if self.interrupted:
                    raise SystemExit(self._interruption.code)
                raise DataError(title, "the input holds nothing to process")

    def finish(
        self, record: results.Record, config: Any, inputs: dict[str, Any], summary: Callable[[dict[str, Any]], str]
    ) -> int:
        """Writes options, metrics and report, and prints one line.

        Args:
            record: of the run.
            config: its options.
            inputs: what the command was given.
            summary: a few words made of the metrics.

        Returns:
            The exit code: 0, or 128 and the number of the signal that ended the run.
        """
        record.interrupted = self.interrupted
        metrics = results.write(record, config, self.out, inputs)
        note = ", interrupted" if self.interrupted else ""
        typer.echo(f"{summary(metrics)}{note}: {self.out / 'report.html'}")
        return self._interruption.code


@contextmanager
def open_run(out: Path) -> Iterator[Run]:
    """Makes the output folder and catches SIGINT and SIGTERM; a folder that was made and stays empty is removed again.

    Args:
        out: folder for the results.

    Yields:
        The run.
    """
    with session.Interruption() as interruption, session.output_folder(out):
        yield Run(out, interruption)
