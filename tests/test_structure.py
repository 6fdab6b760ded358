"""The house rules: rows, lengths, depths, documentation, imports, and what the README promises."""

import ast
import functools
import importlib
import importlib.util
import inspect
import json
import os
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

import jaxloc

REPOSITORY = Path(__file__).resolve().parent.parent
SOURCE = REPOSITORY / "src" / "jaxloc"
FILES = sorted(SOURCE.rglob("*.py"))
README = (REPOSITORY / "README.md").read_text(encoding="utf-8")

LONGEST_FILE, LONGEST_BODY, DEEPEST_CLASS, LARGEST_FOLDER = 400, 50, 2, 12


def name_of(path: Path) -> str:
    return str(path.relative_to(SOURCE))


@functools.cache
def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def module_of(path: Path) -> str:
    parts = path.relative_to(SOURCE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def run_python(code: str, **environment: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, **environment},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr[-4000:]
    return done.stdout


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_files_are_short(path):
    lines = len(path.read_text(encoding="utf-8").splitlines())
    assert lines <= LONGEST_FILE, f"{lines} lines: split it by concept (aim at 80 to 350)"


def body_lines(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Lines of a body without its docstring."""
    body = function.body[1:] if ast.get_docstring(function) is not None else function.body
    return body[-1].end_lineno - body[0].lineno + 1 if body else 0


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_functions_are_short(path):
    functions = [node for node in ast.walk(tree_of(path)) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]
    long = {function.name: body_lines(function) for function in functions if body_lines(function) > LONGEST_BODY}
    assert not long, f"bodies above {LONGEST_BODY} lines: {long}"


@pytest.mark.parametrize("folder", sorted({path.parent for path in FILES}), ids=name_of)
def test_folders_are_small(folder):
    modules = [path.name for path in folder.glob("*.py") if not path.name.startswith("_")]
    assert len(modules) <= LARGEST_FOLDER, f"{len(modules)} modules: split it by concept into folders"


def guarded_imports(tree: ast.Module) -> set[ast.AST]:
    """Imports within a `try` that handles an ImportError."""
    return {
        inner
        for node in ast.walk(tree)
        if isinstance(node, ast.Try)
        if any("ImportError" in ast.unparse(handler.type) for handler in node.handlers if handler.type is not None)
        for statement in node.body
        for inner in ast.walk(statement)
    }


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_unstable_modules_of_jax_are_guarded(path):
    """A module outside JAX's public interface may be gone in its next version: it needs a fallback."""
    unstable = re.compile(r"jax\.(experimental|_src|extend|interpreters)|jaxlib")
    tree = tree_of(path)
    guarded = guarded_imports(tree)
    found = [
        f"line {node.lineno}: {name}"
        for node in ast.walk(tree)
        if isinstance(node, ast.Import | ast.ImportFrom) and node not in guarded
        for name in ([alias.name for alias in node.names] if isinstance(node, ast.Import) else [node.module or ""])
        if unstable.match(name)
    ]
    found += [
        f"line {node.lineno}: {ast.unparse(node)}"
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and unstable.fullmatch(ast.unparse(node))
    ]
    assert not found, found


TESTS = sorted(path for path in (REPOSITORY / "tests").glob("*/**/test_*.py"))


@pytest.mark.parametrize("path", TESTS, ids=lambda path: str(path.relative_to(REPOSITORY / "tests")))
def test_tests_mirror_the_package(path):
    """`tests/<room>/test_<module>.py`, also `test_<module>_<aspect>.py`, or named after its folder."""
    folder = SOURCE / path.parent.relative_to(REPOSITORY / "tests")
    name = path.stem.removeprefix("test_")
    modules = {module.stem for module in folder.glob("*.py")} | {folder.name}
    assert any(name == module or name.startswith(f"{module}_") for module in modules), f"no module {name} in {folder}"


def class_bases() -> dict[str, list[str]]:
    """Every class of jaxloc with the names of its bases."""
    found = {}
    for path in FILES:
        for node in ast.walk(tree_of(path)):
            if isinstance(node, ast.ClassDef):
                found[node.name] = [ast.unparse(base).split("[")[0].split(".")[-1] for base in node.bases]
    return found


def test_classes_are_not_deep():
    bases = class_bases()

    def depth(name: str) -> int:
        return max((1 + depth(base) for base in bases[name] if base in bases and base != name), default=0)

    deep = {name: depth(name) for name in bases if depth(name) > DEEPEST_CLASS}
    assert not deep, f"more than {DEEPEST_CLASS} ancestors within jaxloc: {deep}"


def public_definitions(path: Path) -> Iterator[tuple[str, ast.AST]]:
    tree = tree_of(path)
    yield "the module", tree
    for node in tree.body:
        if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef) or node.name.startswith("_"):
            continue
        yield node.name, node
        for inner in node.body if isinstance(node, ast.ClassDef) else ():
            if isinstance(inner, ast.FunctionDef) and not inner.name.startswith("_"):
                yield f"{node.name}.{inner.name}", inner


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_everything_public_is_documented(path):
    missing = [name for name, node in public_definitions(path) if not ast.get_docstring(node)]
    assert not missing, f"no docstring: {missing}"


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_products_are_exact(path):
    """Accelerators round the factors of a product to ten bits, unless it asks for precision."""
    products = {"einsum", "matmul", "dot", "vdot", "tensordot", "inner", "convolve", "correlate", "dot_general"}
    modules = {"jnp", "lax", "jax.numpy", "jax.lax"}
    rounded = [
        f"line {node.lineno}: {node.func.attr}"
        for node in ast.walk(tree_of(path))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)
        if (node.func.attr in products or node.func.attr.startswith("conv_"))
        and ast.unparse(node.func.value) in modules
        if all(keyword.arg != "precision" for keyword in node.keywords)
    ]
    assert not rounded, rounded


@pytest.mark.parametrize("path", [path for path in FILES if path.parent.name != "_linalg"], ids=name_of)
def test_decompositions_are_those_of_linalg(path):
    """Others can deadlock in batches (docs/lapack_deadlock.md), but for determinants of up to three rows."""
    unsafe = re.compile(
        r"(jnp|lax|jax\.numpy|jax\.lax)\.linalg\.(?!norm$|det$)\w+|(jax\.)?scipy\.linalg\.(?!block_diag$)\w+"
        r"|(lx|lineax)\.(QR|LU|SVD|Cholesky|AutoLinearSolver)"
    )
    names = [
        (node.lineno, ast.unparse(node) if isinstance(node, ast.Attribute) else f"{node.module}.{alias.name}")
        for node in ast.walk(tree_of(path))
        if isinstance(node, ast.Attribute | ast.ImportFrom)
        for alias in (node.names if isinstance(node, ast.ImportFrom) else [None])
    ]
    found = [f"line {line}: {name}" for line, name in names if unsafe.fullmatch(name)]
    assert not found, found


def test_rooms_import_only_lower_rows():
    if importlib.util.find_spec("importlinter") is None:
        pytest.skip("import-linter is not installed")
    code = "import sys; from importlinter.cli import lint_imports_command; sys.argv = ['lint-imports', '--no-cache']; "
    done = subprocess.run(
        [sys.executable, "-c", code + "lint_imports_command()"], cwd=REPOSITORY, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_no_room_starts_a_backend():
    rooms = sorted({module_of(path) for path in FILES} - {"jaxloc.__main__", "jaxloc.cli.app"})
    run_python(f"import importlib\nfor name in {rooms!r}: importlib.import_module(name)", JAX_PLATFORMS="no_such")


def test_importing_the_package_imports_nothing_heavy():
    loaded = set(run_python("import sys, jaxloc; print(*sys.modules)").split())
    assert not loaded & {"jax", "numpy", "equinox", "optimistix", "cv2", "matplotlib", "scipy"}


def test_every_room_is_named():
    rooms = {path.parent.name for path in SOURCE.glob("[!_]*/__init__.py")} - {"cli"}
    assert rooms == set(jaxloc._ROOMS)
    assert rooms <= set(dir(jaxloc))
    for room in rooms:
        assert inspect.ismodule(getattr(jaxloc, room))


def test_versions_agree():
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project["version"] == jaxloc.__version__


def readme_blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", README, flags=re.MULTILINE | re.DOTALL)


def test_readme_commands_are_those_of_the_ci():
    commands = [line for block in readme_blocks("sh") for line in block.splitlines() if "venv" in line]
    script = (REPOSITORY / ".ci" / "run").read_text(encoding="utf-8")
    assert len(commands) == 2
    assert re.findall(r"^readonly \w+_command='(.*)'$", script, flags=re.MULTILINE) == commands


@pytest.mark.slow
def test_readme_code_runs(capsys):
    names: dict = {}
    for code in readme_blocks("python"):
        exec(compile(code, "README.md", "exec"), names)
    printed = capsys.readouterr().out
    assert printed.startswith("True (1000, 6, 6)") and printed.endswith("(50, 2)\nTrue\n")


def test_readme_links_lead_somewhere():
    if not (REPOSITORY / "docs").is_dir():
        pytest.skip("the images are not there")
    for target in re.findall(r"\]\((?!https?:)([^)#]+)\)", README):
        assert (REPOSITORY / target).exists(), target


def test_readme_figures_are_those_of_the_baseline(monkeypatch):
    baseline = REPOSITORY / "benchmarks" / "baseline.json"
    if not baseline.exists():
        pytest.skip("no baseline")
    monkeypatch.syspath_prepend(str(REPOSITORY))
    fill = importlib.import_module("benchmarks.__main__").fill

    figures = json.loads(baseline.read_text(encoding="utf-8"))["metrics"]
    unknown = set(re.findall(r"<!-- figure: ([\w.]+) -->", README)) - set(figures)
    assert not unknown, f"not in the baseline: {unknown}"
    assert fill(README, figures) == README, "run python -m benchmarks --readme README.md"


# Metaphors and words that nobody in the field would search for, each with what to write. Checked as whole words in
# lower case; identifiers count too, split at underscores.
BANNED = {
    "picture": "image",
    "pictures": "images",
    "grey": "gray",
    "glass": "lens",
    "twin": "counterpart",
    "nobody": "no one, none",
    "proof against": "robust to",
    "a hair from": "within rounding of",
    "come home": "return",
    "comes home": "returns",
    "speak": "confirm, report",
    "speaks": "favors",
    "spoken": "confirmed, reported",
    "told": "given, known",
    "says of itself": "reports",
    "say of itself": "report",
    "nobody is there": "empty",
    "bad numbers": "non-finite values",
    "gone bad": "non-finite",
    "at its door": "at its inputs",
    "at the door": "at the inputs",
    "the way back": "the inverse",
    "honest": "consistent",
    "colour": "color",
    "labelled": "labeled",
    "neighbour": "neighbor",
    "metre": "meter",
    "centre": "center",
}


def words_of(path: Path) -> Iterator[tuple[int, str]]:
    """Lines of a file as lower-case words: identifiers split at underscores, code spans and links left in."""
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
        yield number, f" {' '.join(re.findall('[a-z]+', line.replace('_', ' ').lower()))} "


@pytest.mark.parametrize(
    "path",
    [*FILES, REPOSITORY / "README.md", REPOSITORY / "CONTRIBUTING.md"],
    ids=lambda path: str(path.relative_to(REPOSITORY)),
)
def test_words_are_those_of_the_field(path):
    found = [
        f"line {number}: {banned!r}, write {instead!r}"
        for number, line in words_of(path)
        for banned, instead in BANNED.items()
        if f" {banned} " in line
    ]
    assert not found, found


def project_files() -> Iterator[Path]:
    folders = ("src", "tests", "benchmarks", "notebooks", ".ci", "docs")
    for path in [*REPOSITORY.iterdir(), *(path for folder in folders for path in (REPOSITORY / folder).rglob("*"))]:
        if path.is_file() and path.suffix in {"", ".py", ".md", ".toml", ".yaml", ".yml", ".json", ".ipynb", ".jinja"}:
            yield path


def test_no_machine_paths():
    # Put together here, so that this file passes too.
    forbidden = re.compile("|".join("/" + folder + "/" for folder in ("work", "tmp", "home", "root", "Users")))
    found = [
        f"{path.relative_to(REPOSITORY)}: {line.strip()[:80]}"
        for path in project_files()
        for line in path.read_text(encoding="utf-8").splitlines()
        if forbidden.search(line)
    ]
    assert not found, found
