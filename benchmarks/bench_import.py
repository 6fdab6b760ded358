"""What ``import jaxloc`` costs beside ``import jax``, each in a process of its own."""

import os
import subprocess
import sys
from collections.abc import Iterator

from benchmarks.metric import RATIO, Metric

_STATEMENTS = {
    "jax": "import jax",
    "jaxloc": "import jaxloc",
    "refinement": "import jaxloc; jaxloc.refinement",
    "optimistix": "import optimistix",
}


def metrics(smoke: bool) -> Iterator[Metric]:
    seconds = {name: _seconds(statement, 1 if smoke else 5) for name, statement in _STATEMENTS.items()}
    for name, value in seconds.items():
        yield Metric(f"import.{name}", value, "s")
    yield Metric("import.jaxloc_over_jax", seconds["jaxloc"] / seconds["jax"], "x")
    yield Metric(
        "import.refinement_over_optimistix", seconds["refinement"] / seconds["optimistix"], "x", "lower", RATIO
    )


def _seconds(statement: str, repeats: int) -> float:
    """Least processor time of a fresh interpreter, less that of an empty one."""
    return min(_once(statement) for _ in range(repeats)) - min(_once("pass") for _ in range(repeats))


def _once(statement: str) -> float:
    before = os.times()
    subprocess.run([sys.executable, "-c", statement], check=True, stdin=subprocess.DEVNULL)
    after = os.times()
    return (after.children_user - before.children_user) + (after.children_system - before.children_system)
