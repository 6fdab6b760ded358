"""The notebooks run from top to bottom, quickly, in a process of their own."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parent.parent
NOTEBOOKS = sorted((REPOSITORY / "notebooks").glob("[0-9]*.py"))

_RUN = "import runpy, sys; runpy.run_path(sys.argv[1], run_name='__main__')"


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_runs(notebook, tmp_path):
    environment = {
        **os.environ,
        "JAXLOC_FAST": "1",
        "MPLBACKEND": "Agg",
        "JAX_COMPILATION_CACHE_DIR": os.environ.get("JAX_COMPILATION_CACHE_DIR", str(REPOSITORY / ".jax_cache")),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.2",
    }
    command = [sys.executable, "-c", _RUN, str(notebook)]
    done = subprocess.run(
        command, cwd=tmp_path, env=environment, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stderr[-4000:]


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_is_part_of_a_course(notebook):
    cells = ("\n" + notebook.read_text(encoding="utf-8")).split("\n# %% [markdown]\n")
    assert notebook.stem[:2].isdigit()
    assert cells[1].startswith("# # "), "begin with a title"
    assert "## Takeaways" in cells[-1] and "## Next steps" in cells[-1], "end with takeaways and next steps"


@pytest.mark.parametrize("notebook", sorted(REPOSITORY.glob("notebooks/*.ipynb")), ids=lambda path: path.stem)
def test_executed_notebook_is_small_and_has_its_source(notebook):
    assert notebook.stat().st_size <= 300_000
    assert notebook.with_suffix(".py").exists()
