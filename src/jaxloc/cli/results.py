"""What every command leaves behind: the options it ran with, numbers, and a page."""

import json
import math
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import jaxloc
from jaxloc.cli import configuration, session
from jaxloc.data.io.writing import write_file
from jaxloc.evaluation import report


@runtime_checkable
class Record(Protocol):
    """What a run says of itself."""

    def metrics(self) -> dict[str, Any]:
        """Numbers, fit for JSON."""
        ...

    def page(self, metrics: dict[str, Any]) -> str:
        """The report."""
        ...


def check_extras() -> None:
    """Checks that the libraries of the report are there.

    Raises:
        ImportError: when one is not, with what to do.
    """
    try:
        import jinja2  # noqa: F401
        import matplotlib.figure  # noqa: F401
        import rich  # noqa: F401
    except ImportError as error:
        raise ImportError(f'reports need {error.name}: pip install "jaxloc[cli]"') from error


def prepare(out: Path) -> None:
    """Checks all that can fail before any input is read: the output folder, and the libraries for the results.

    Raises:
        DataError: when the folder cannot be used.
        ImportError: when a library is not there.
    """
    session.check_output(out)
    check_extras()
    configuration.load_yaml()
    session.keep_compilations()


def write(record: Record, config: Any, out: Path, inputs: dict[str, Any]) -> dict[str, Any]:
    """Writes ``config.yaml``, ``metrics.json`` and ``report.html``.

    Args:
        record: of the run.
        config: its options.
        out: folder for the files.
        inputs: what the command was given.

    Returns:
        The metrics.

    Raises:
        DataError: when a file cannot be written.
    """
    yaml = configuration.load_yaml()
    settings = {"jaxloc": jaxloc.__version__, **inputs, "config": configuration.to_plain(config)}
    write_file(out / "config.yaml", yaml.safe_dump(settings, sort_keys=False))
    metrics = record.metrics()
    write_file(out / "metrics.json", json.dumps(metrics, indent=2, allow_nan=False) + "\n")
    write_file(out / "report.html", record.page(metrics))
    return metrics


def finite(value: Any) -> Any:
    """JSON has no infinity and no NaN: null stands for them."""
    if isinstance(value, dict):
        return {key: finite(item) for key, item in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value


def table(metrics: dict[str, Any]) -> report.Table:
    """Metrics as rows of the report."""
    rows = []
    for name, value in metrics.items():
        parts = value.items() if isinstance(value, dict) else [("", value)]
        rows += [(f"{name} {part}".strip(), _format(number)) for part, number in parts]
    return report.Table(("metric", "value"), tuple(rows))


def _format(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(_format(item) for item in value)
    return f"{value:.4g}" if isinstance(value, float) and value < 1e4 else str(value)
