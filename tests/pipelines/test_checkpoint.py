"""Checkpoints: what is restored, and files that cannot be."""

import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.pipelines import checkpoint


class Inner(eqx.Module):
    values: jax.Array
    table: np.ndarray
    name: str = eqx.field(static=True, default="a")


class State(eqx.Module):
    inner: Inner
    key: jax.Array
    count: int
    time: float
    flag: bool
    pair: tuple[int, int]


class Growing(eqx.Module):
    items: tuple[Inner, ...]

    def sizes(self):
        return {"items": len(self.items)}

    def resized(self, sizes):
        return Growing((Inner(jnp.zeros(0), np.zeros((0, 2))),) * sizes["items"])


def make(size=3):
    inner = Inner(jnp.arange(size, dtype=jnp.float32), np.arange(2.0 * size).reshape(size, 2))
    return State(inner, jax.random.key(7), 5, 0.1, True, (3, 4))


def empty():
    return State(Inner(jnp.zeros(0), np.zeros((0, 2))), jax.random.key(0), 0, 0.0, False, (0, 0))


@pytest.fixture
def saved(tmp_path):
    checkpoint.save(tmp_path / "a.state", make())
    return tmp_path / "a.state"


def test_everything_is_restored_with_its_type(saved):
    state, found = make(), checkpoint.restore(saved, empty())
    assert eqx.tree_equal(eqx.tree_at(lambda s: s.key, state, 0), eqx.tree_at(lambda s: s.key, found, 0))
    assert jax.random.uniform(found.key) == jax.random.uniform(state.key)
    assert type(found.count) is int and type(found.time) is float and found.flag is True and found.pair == (3, 4)
    assert isinstance(found.inner.table, np.ndarray) and found.inner.table.dtype == np.float64


def test_lists_that_grow(tmp_path):
    state = Growing(tuple(make(size).inner for size in (1, 4, 2)))
    checkpoint.save(tmp_path / "a.state", state)
    assert eqx.tree_equal(checkpoint.restore(tmp_path / "a.state", Growing(())), state)


def test_an_earlier_file_stays_until_the_new_one_is_complete(saved, monkeypatch):
    before = saved.read_bytes()

    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr(eqx, "tree_serialise_leaves", fail)
    with pytest.raises(OSError, match="disk full"):
        checkpoint.save(saved, make(9))
    assert saved.read_bytes() == before and [path.name for path in saved.parent.iterdir()] == ["a.state"]


def header_of(data):
    start = data.index(b"\n") + 9
    length = int.from_bytes(data[start - 8 : start], "little")
    return json.loads(data[start : start + length]), data[start + length :]


def file_of(header, leaves):
    text = json.dumps(header).encode()
    return b"jaxloc checkpoint 1\n" + len(text).to_bytes(8, "little") + text + leaves


def spoil_header(change):
    def spoil(data):
        header, leaves = header_of(data)
        change(header)
        return file_of(header, leaves)

    return spoil


@pytest.mark.parametrize(
    "spoil, match",
    [
        (lambda data: b"", "is no checkpoint"),
        (lambda data: b"\x80\x04\x95 pickle", "is no checkpoint"),
        (lambda data: data[:20], "is no checkpoint"),
        (lambda data: data[:40], "truncated header"),
        (lambda data: data[:20] + b"\xff" * 8 + data[28:], "truncated header"),
        (lambda data: data[:-1], "damaged"),
        (lambda data: data[:-200], "damaged"),
        (lambda data: data + b"x", "more data"),
        (lambda data: file_of({}, b""), "damaged checkpoint"),
        (lambda data: file_of([1], b""), "damaged checkpoint"),
        (lambda data: data[:28] + b"[" * (len(data) - 28), "damaged checkpoint"),
        (spoil_header(lambda h: h.update(type="os.system")), "holds a os.system, not a"),
        (spoil_header(lambda h: h.update(sizes={"items": 3})), "another structure"),
        (spoil_header(lambda h: h["leaves"].pop()), "another structure"),
        (spoil_header(lambda h: h["leaves"][0].__setitem__(1, "float64")), "precision"),
        (spoil_header(lambda h: h["leaves"][0].__setitem__(2, [10**12])), "truncated"),
        (spoil_header(lambda h: h["leaves"][0].__setitem__(2, [-3])), "dimensions are needed"),
        (spoil_header(lambda h: h["leaves"][0].__setitem__(2, [3, 1])), "dimensions are needed"),
        (spoil_header(lambda h: h["leaves"][0].__setitem__(2, [2])), "damaged"),
    ],
)
def test_files_that_cannot_be_restored(saved, spoil, match):
    saved.write_bytes(spoil(saved.read_bytes()))
    with pytest.raises(ValueError, match=match) as error:
        checkpoint.restore(saved, empty())
    assert str(error.value).startswith(str(saved)) and "\n" not in str(error.value)


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(ValueError, match="no.state: No such file"):
        checkpoint.restore(tmp_path / "no.state", empty())
