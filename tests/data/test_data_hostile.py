"""Every reader on mutated files: a result of finite numbers, or a `DataError` in one line.

`JAXLOC_MUTATIONS=1000 pytest tests/data/test_data_hostile.py` tries more.
"""

import importlib
import inspect
import os
import pkgutil
import zlib
from pathlib import Path

import equinox as eqx
import jax
import numpy as np
import pytest

import jaxloc.data
from hostile_seeds import SEEDS
from jaxloc.data import DataError

COUNT = int(os.environ.get("JAXLOC_MUTATIONS", "60"))
# Words that numbers are replaced by, and bytes that are put in.
WORDS = tuple(
    b"nan inf -inf 1e400 -1e400 1e300 1e39 -1e39 1e-320 -1 0 -0 0.5 1e5 999999 1e12 9007199254740993 1_0 0x10 1,5 x "
    b"!!bool ~ true .nan .5 5. 1e+03 ''".split()
) + (b"9" * 400, b"1" + b"0" * 5000, b"[" * 100, b"\xc2\xb2")
PIECES = (
    b"\0",
    b"\xef\xbb\xbf",
    b"\xff\xfe",
    b"\xfe\xff",
    b"\n",
    b"\r\n",
    b"\r",
    b" ",
    b"\t",
    b"-",
    b"#",
    b"\xff",
    b"\x0c",
)
# Readings that failed, and positions that are not known, may be no numbers.
UNKNOWN = {"ranges", "landmarks"}


def readers() -> set[str]:
    """Names of all functions of the package's readers that take a path."""
    found = set()
    for module in pkgutil.walk_packages(jaxloc.data.__path__, "jaxloc.data."):
        loaded = importlib.import_module(module.name)
        for name, value in vars(loaded).items():
            if inspect.isfunction(inspect.unwrap(value)) and value.__module__ == module.name:
                if name.startswith(("read_", "open_recording", "verify_")) and name != "read_bytes":
                    found.add(f"{module.name.rpartition('.')[2]}.{name}")
    return found


def test_every_reader_has_a_seed():
    missing = readers() - {name.split()[0] for name in SEEDS}
    assert not missing, f"add valid files for {sorted(missing)} to hostile_seeds.py"


def mutate(data: bytes, rng: np.random.Generator) -> bytes:
    """One to three changes: cut, flip, repeat, leave out, replace a number, put something in."""
    for _ in range(rng.integers(1, 4)):
        place, length = int(rng.integers(0, len(data) + 1)), int(rng.integers(1, 40))
        match int(rng.integers(0, 7)):
            case 0:
                data = data[:place]
            case 1 if place < len(data):
                data = data[:place] + bytes([data[place] ^ 1 << int(rng.integers(8))]) + data[place + 1 :]
            case 2:
                data = data[:place] + data[place : place + length] * int(rng.integers(2, 5)) + data[place + length :]
            case 3:
                data = data[:place] + data[place + length :]
            case 4:
                data = data[:place] + PIECES[rng.integers(len(PIECES))] + data[place:]
            case 5:
                data = PIECES[rng.integers(1, 4)] + data
            case _:
                words = data.split(b" ")
                words[rng.integers(len(words))] = WORDS[rng.integers(len(WORDS))]
                data = b" ".join(words)
    return data


def write(folder: Path, files: dict[str, bytes]) -> Path:
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    return folder / next(iter(files))


def check_finite(result: object) -> None:
    for place, leaf in jax.tree_util.tree_leaves_with_path(result):
        unknown = any(getattr(key, "name", None) in UNKNOWN for key in place)
        if eqx.is_inexact_array_like(leaf) and not unknown:
            assert np.isfinite(leaf).all(), (jax.tree_util.keystr(place), np.asarray(leaf))


@pytest.mark.parametrize("name", SEEDS)
def test_mutated_files_are_read_or_refused(tmp_path, name):
    seed = SEEDS[name]
    path = write(tmp_path, seed.files)
    check_finite(seed.read(tmp_path))
    rng = np.random.default_rng(zlib.crc32(name.encode()))
    content = path.read_bytes()
    for number in range(COUNT):
        mutated = mutate(content, rng)
        path.write_bytes(mutated)
        try:
            check_finite(seed.read(tmp_path))
        except DataError as error:
            assert len(str(error).splitlines()) == 1 and str(error).isprintable(), (number, str(error))
        except BaseException as error:
            error.add_note(f"mutation {number} of {name}: {mutated[:2000]!r}")
            raise


@pytest.mark.parametrize("name", SEEDS)
def test_pipes_folders_and_odd_names_are_refused(tmp_path, name):
    seed = SEEDS[name]
    path = write(tmp_path, seed.files)
    path.unlink()
    os.mkfifo(path)
    try:
        seed.read(tmp_path)
    except DataError as error:
        assert "\n" not in str(error)
    path.unlink()
    path.mkdir()
    try:
        seed.read(tmp_path)
    except DataError as error:
        assert "\n" not in str(error)
    for odd in ("a\0b", "a" * 5000, "a\nb"):
        with pytest.raises(DataError) as caught:
            seed.read(tmp_path / odd)
        assert str(caught.value).isprintable()
