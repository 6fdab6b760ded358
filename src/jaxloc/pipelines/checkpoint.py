"""Checkpoints of a pipeline's state: saved to a file, and restored to continue with the same numbers.

A file is a line that names the format, a JSON header with the path, type and shape of every leaf, and the leaves in
NumPy's format, written by `equinox.tree_serialise_leaves`. Nothing in it is executed: no pickle.
"""

import io
import json
import os
from pathlib import Path
from typing import Any, Protocol, TypeVar, runtime_checkable

import equinox as eqx
import jax
import numpy as np

__all__ = ["Resizable", "restore", "save"]

_MAGIC = b"jaxloc checkpoint 1\n"
_LENGTH = 8  # bytes of the header's length
_MOST_HEADER = 1 << 26

_State = TypeVar("_State")


@runtime_checkable
class Resizable(Protocol):
    """A state whose number of leaves grows, such as a list of images."""

    def sizes(self) -> dict[str, int]:
        """Lengths of the lists that grow."""
        ...

    def resized(self, sizes: dict[str, int]) -> Any:
        """A state with lists of these lengths; their contents do not matter."""
        ...


def save(path: Path | str, state: Any) -> None:
    """Writes a state, in one step: an earlier file stays until the new one is complete.

    Args:
        path: the file.
        state: of any pipeline, or any pytree of arrays and numbers. Typed PRNG keys are stored as their key data.
    """
    path, plain = Path(path), jax.tree.map(_key_data, state)
    header = {"type": _type_name(state), "sizes": _sizes(state), "leaves": _describe(plain)}
    text = json.dumps(header).encode()
    temporary = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        with temporary.open("wb") as file:
            file.write(_MAGIC + len(text).to_bytes(_LENGTH, "little") + text)
            eqx.tree_serialise_leaves(file, plain)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def restore(path: Path | str, like: _State) -> _State:
    """Reads a state.

    Args:
        path: the file.
        like: a state of the same pipeline, such as ``init(config, ...)`` gives: its structure, types and dtypes are
            those of the result; all its values and shapes come from the file.

    Returns:
        The state that was saved.

    Raises:
        ValueError: the file is missing, damaged, or of another pipeline, precision or structure.

    Example:
        >>> import jax, tempfile
        >>> from pathlib import Path
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save(Path(folder) / "a.state", {"key": jax.random.key(3), "count": 7})
        ...     state = restore(Path(folder) / "a.state", {"key": jax.random.key(0), "count": 0})
        >>> state["count"], jax.random.key_data(state["key"]).tolist()
        (7, [0, 3])
    """
    path = Path(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror}") from None
    try:
        return _read(data, like)
    except _Unusable as error:
        raise ValueError(f"{path}: {error}") from None
    except (Exception, MemoryError) as error:  # whatever NumPy or JSON make of damaged bytes
        message = " ".join(str(error).split())[:200]
        raise ValueError(f"{path}: is a damaged checkpoint ({type(error).__name__}: {message})") from None


class _Unusable(Exception):
    """A file that does not hold the state that is asked for."""


def _read(data: bytes, like: Any) -> Any:
    start = len(_MAGIC) + _LENGTH
    if not data.startswith(_MAGIC) or len(data) < start:
        raise _Unusable("is no checkpoint of jaxloc")
    length = int.from_bytes(data[len(_MAGIC) : start], "little")
    if length > min(_MOST_HEADER, len(data) - start):
        raise _Unusable("is a damaged checkpoint (truncated header)")
    header = json.loads(data[start : start + length])
    if header["type"] != _type_name(like):
        raise _Unusable(f"holds a {header['type']}, not a {_type_name(like)}")
    like = _resize(like, header["sizes"], len(data))
    plain = jax.tree.map(_key_data, like)
    template = _shaped(plain, header["leaves"], len(data) - start - length)
    stream = io.BytesIO(data[start + length :])
    loaded = eqx.tree_deserialise_leaves(stream, template)
    if stream.read(1):
        raise _Unusable("is a damaged checkpoint (more data than its header says)")
    return jax.tree.map(_with_key, like, loaded)


def _resize(like: Any, sizes: Any, most: int) -> Any:
    if sizes == _sizes(like):
        return like
    if not isinstance(like, Resizable) or sizes.keys() != _sizes(like).keys():
        raise _Unusable("holds a state of another structure")
    if not all(type(size) is int and 0 <= size <= most for size in sizes.values()):
        raise _Unusable("is a damaged checkpoint (lengths of lists)")
    return like.resized(sizes)


def _shaped(plain: Any, leaves: Any, most: int) -> Any:
    """The structure of a state with the shapes of a file, without allocating more than the file holds."""
    own = _describe(plain)
    if [leaf[:2] for leaf in own] != [leaf[:2] for leaf in leaves]:
        different = next(((a, b) for a, b in zip(own, leaves, strict=False) if a[:2] != b[:2]), None)
        detail = "" if different is None else f": {different[1][:2]} where {different[0][:2]} is needed"
        raise _Unusable(f"holds a state of another structure or precision{detail}")
    total, shapes = 0, []
    for (name, dtype, shape), (_, _, size) in zip(own, leaves, strict=True):
        if len(shape) != len(size) or not all(type(n) is int and n >= 0 for n in size):
            raise _Unusable(f"holds {name} of shape {size}, but {len(shape)} dimensions are needed")
        item = 1 if dtype in ("bool", "int", "float") else np.dtype(dtype).itemsize
        total += int(np.prod(size, dtype=object)) * item
        shapes.append(tuple(size))
    if total > most:
        raise _Unusable("is a damaged checkpoint (truncated)")
    values, structure = jax.tree.flatten(plain)
    arrays = iter(shapes)
    return structure.unflatten([_empty(value, next(arrays)) if _stored(value) else value for value in values])


def _empty(value: Any, shape: tuple[int, ...]) -> Any:
    if isinstance(value, jax.Array):
        return jax.ShapeDtypeStruct(shape, value.dtype)
    return np.empty(shape, value.dtype) if isinstance(value, np.ndarray) else value


def _describe(plain: Any) -> list[list[Any]]:
    """Path, dtype and shape of every leaf that is stored."""
    leaves = jax.tree_util.tree_leaves_with_path(plain)
    return [[jax.tree_util.keystr(name), *_kind(leaf)] for name, leaf in leaves if _stored(leaf)]


def _kind(leaf: Any) -> tuple[str, list[int]]:
    if isinstance(leaf, jax.Array | np.ndarray):
        return str(leaf.dtype), list(leaf.shape)
    return type(leaf).__name__, []


def _stored(leaf: Any) -> bool:
    return isinstance(leaf, jax.Array | np.ndarray | bool | int | float)


def _is_key(leaf: Any) -> bool:
    return isinstance(leaf, jax.Array) and jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _key_data(leaf: Any) -> Any:
    return jax.random.key_data(leaf) if _is_key(leaf) else leaf


def _with_key(like: Any, leaf: Any) -> Any:
    return jax.random.wrap_key_data(leaf, impl=jax.random.key_impl(like)) if _is_key(like) else leaf


def _sizes(state: Any) -> dict[str, int]:
    return state.sizes() if isinstance(state, Resizable) else {}


def _type_name(state: Any) -> str:
    return f"{type(state).__module__}.{type(state).__qualname__}"
