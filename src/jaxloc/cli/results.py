"""Results of every command: ``config.yaml``, ``metrics.json`` and ``report.html``."""

import json
import math
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import jaxloc
from jaxloc.cli import options
from jaxloc.data.io.writing import write_file
from jaxloc.data.io.yaml_file import load_yaml
from jaxloc.evaluation import report


@runtime_checkable
class Record(Protocol):
    """Results of a run: metrics and report.

    Attributes:
        interrupted: whether the run ended early.
    """

    interrupted: bool

    def metrics(self) -> dict[str, Any]:
        """Numbers for ``metrics.json``."""
        ...

    def page(self, metrics: dict[str, Any]) -> str:
        """The report as HTML."""
        ...


def check_extras() -> None:
    """Checks that the libraries of the report are installed.

    Raises:
        ImportError: when one is not, with what to do.
    """
    try:
        import jinja2  # noqa: F401
        import matplotlib.figure  # noqa: F401
        import rich  # noqa: F401
    except ImportError as error:
        raise ImportError(f'reports need {error.name}: pip install "jaxloc[cli]"') from error


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
    settings = {"jaxloc": jaxloc.__version__, **inputs, "config": options.to_plain(config)}
    write_file(out / "config.yaml", load_yaml().safe_dump(settings, sort_keys=False))
    metrics = record.metrics()
    write_file(out / "metrics.json", json.dumps(metrics, indent=2, allow_nan=False) + "\n")
    write_file(out / "report.html", record.page(metrics))
    return metrics


def finite(value: Any) -> Any:
    """Numbers for JSON: None in place of infinity and NaN."""
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


def highlights(metrics: dict[str, Any], wanted: tuple[tuple[str, str, str], ...]) -> tuple[report.Highlight, ...]:
    """The most important metrics, for the top of the report.

    Args:
        metrics: of the run.
        wanted: name, label and format of each; those that are None or absent are left out.
    """
    found = [(label, form.format(metrics[name])) for name, label, form in wanted if metrics.get(name) is not None]
    return tuple(report.Highlight(label, value) for label, value in found)


def numbers_section(metrics: dict[str, Any]) -> report.Section:
    """The section of the report with all metrics."""
    return report.Section("Numbers", "SI units, or the unit in the name.", table=table(metrics))
