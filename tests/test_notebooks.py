"""The notebooks are a course, and small. That they run is a check of its own: `notebooks/execute.py --check`."""

from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parent.parent
NOTEBOOKS = sorted((REPOSITORY / "notebooks").glob("[0-9]*.py"))


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
