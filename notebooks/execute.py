"""Runs the notebooks' percent scripts and writes them, with their outputs, as .ipynb files beside them.

``python notebooks/execute.py [--check] [FILE ...]``; with ``--check`` nothing is written.
"""

import argparse
import sys
from pathlib import Path

import jupytext
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError

HERE = Path(__file__).resolve().parent
LARGEST = 300_000  # bytes of an executed notebook


def execute(script: Path, check: bool) -> str | None:
    """Runs a notebook.

    Returns:
        What is wrong with it, if anything.
    """
    notebook = jupytext.read(script)
    notebook.metadata["kernelspec"] = {"name": "python3", "display_name": "Python 3", "language": "python"}
    client = NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(HERE)}})
    try:
        client.execute()
    except CellExecutionError as error:
        return str(error)
    for number, cell in enumerate(notebook.cells):
        # No time stamps and no random names: the same outputs give the same file.
        cell["id"] = f"cell-{number}"
        cell.metadata = {}
        if cell.cell_type == "code":
            cell.outputs = [output for output in cell.outputs if output.get("name") != "stderr"]
    text = jupytext.writes(notebook, fmt="ipynb")
    if len(text.encode()) > LARGEST:
        return f"{len(text.encode())} bytes, at most {LARGEST}: plot less or at a lower resolution"
    if not check:
        script.with_suffix(".ipynb").write_text(text + "\n", encoding="utf-8")
    return None


def main() -> int:
    """Runs the command.

    Returns:
        The exit code: 1 when a notebook failed.
    """
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", nargs="*", type=Path, default=sorted(HERE.glob("[0-9]*.py")))
    parser.add_argument("--check", action="store_true", help="write nothing")
    options = parser.parse_args()
    failures = 0
    for script in options.files:
        problem = execute(script, options.check)
        failures += problem is not None
        print(f"{script.name}: {problem or 'runs'}", flush=True)
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
