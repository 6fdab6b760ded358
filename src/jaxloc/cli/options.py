"""Options of a pipeline: read from YAML, overridden by ``--set name=value``, and written as YAML.

Records are converted by cattrs, strictly: no number is made of a word, no whole number of a fraction. A record that
stands for a choice, such as a detector, is a mapping with its class's name as ``type``, or the name alone.
"""

import dataclasses
import difflib
import inspect
import math
import typing
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxloc.data import DataError
from jaxloc.data.io.yaml_file import load_yaml, parse_yaml, read_yaml

TYPE = "type"


class _Invalid(ValueError):
    """A value of the wrong type; the message continues the option's name."""


def to_plain(value: Any) -> Any:
    """Converts a record to numbers, strings, lists and mappings, as YAML and JSON can hold them.

    Args:
        value: a record of options, or any pytree of records, arrays, paths and plain values.
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: _plain_field(value, field.name) for field in dataclasses.fields(value)}
    if isinstance(value, dict):
        return {str(key): to_plain(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [to_plain(item) for item in value]
    if isinstance(value, bool | int | float | str) or value is None:
        return value
    return np.asarray(value).tolist() if hasattr(value, "__array__") else str(value)


def _plain_field(record: Any, name: str) -> Any:
    value = getattr(record, name)
    plain = to_plain(value)
    return {TYPE: type(value).__name__, **plain} if _is_choice(_declared(record, name)) else plain


def format_options(value: Any) -> str:
    """The options as YAML: a template for ``--config``."""
    return load_yaml().safe_dump(to_plain(value), sort_keys=False)


def check_extras() -> None:
    """Checks that the libraries for options are installed.

    Raises:
        ImportError: when one is not, with what to do.
    """
    load_yaml()
    _converter()


def read_options(default: Any, path: Path | None = None, settings: Sequence[str] = ()) -> Any:
    """Reads options over the default ones.

    Args:
        default: the record with the default options.
        path: YAML file: a mapping of options, or an earlier ``config.yaml``, whose part ``config`` counts.
        settings: ``name=value`` with a dotted name, applied last.

    Returns:
        A record of the same type.

    Raises:
        DataError: a file is missing or malformed, an option is unknown, or a value is of the wrong type or range.
    """
    record = default
    if path is not None:
        given = read_yaml(path)
        if isinstance(given, dict) and "config" in given:
            given = given["config"]
        record = _apply(path, record, {} if given is None else given)
    for setting in settings:
        record = _apply("--set", record, _nested(setting))
    return record


def _nested(setting: str) -> dict[str, Any]:
    """``a.b=1`` as ``{"a": {"b": 1}}``."""
    name, equals, text = setting.partition("=")
    names = [part.strip() for part in name.split(".")]
    if not equals or not all(names):
        raise DataError("--set", f"is {setting!r}, must be like name=value or part.name=value")
    value = parse_yaml("--set", text)
    for part in reversed(names):
        value = {part: value}
    return value


def _apply(source: Path | str, record: Any, given: Any) -> Any:
    """A record with some options replaced."""
    try:
        return _converter().structure(_merge(record, given, type(record), ""), type(record))
    except _Invalid as error:
        raise DataError(source, str(error)) from None
    except Exception as error:
        import cattrs

        if not isinstance(error, cattrs.BaseValidationError | ValueError | TypeError | OverflowError):
            raise
        raise DataError(source, _first_line(error)) from None


def _merge(record: Any, given: Any, declared: Any, prefix: str) -> Any:
    """A record as plain values, with the given ones in place of its own."""
    values: dict[str, Any] = {}
    if _is_choice(declared):
        given = {TYPE: given} if isinstance(given, str) else given
        record = _choose(record, given, declared, prefix)
        values[TYPE] = type(record).__name__
    if not isinstance(given, dict):
        raise _Invalid(f"{prefix.rstrip('.') or 'the file'} must be a mapping of options to values")
    names = [field.name for field in dataclasses.fields(record)]
    for name in given:
        if name not in (*names, *values):
            raise _Invalid(f"no option {prefix}{name}{_suggest(name, names)}; there are {', '.join(names) or 'none'}")
    for name in names:
        if name not in given:
            values[name] = _plain_field(record, name)
        elif dataclasses.is_dataclass(getattr(record, name)):
            values[name] = _merge(getattr(record, name), given[name], _declared(record, name), f"{prefix}{name}.")
        else:
            values[name] = given[name]
    return values


def _choose(record: Any, given: Any, base: type, prefix: str) -> Any:
    """The default record of the type that is given, or the record as it is."""
    if not isinstance(given, dict) or TYPE not in given or given[TYPE] == type(record).__name__:
        return record
    return _choices(base, prefix, given[TYPE])()


def _choices(base: type, prefix: str, name: Any) -> type:
    """The class of a choice by its name."""
    known = {kind.__name__: kind for kind in _concrete(base)}
    if not isinstance(name, str) or name not in known:
        raise _Invalid(f"{prefix}{TYPE} is {name!r}{_suggest(name, known)}; there are {', '.join(sorted(known))}")
    return known[name]


def _suggest(name: Any, known: Iterable[str]) -> str:
    close = difflib.get_close_matches(str(name), list(known), n=1)
    return f" (did you mean {close[0]}?)" if close else ""


def _declared(record: Any, name: str) -> Any:
    """The declared type of a field."""
    return typing.get_type_hints(type(record)).get(name)


def _concrete(base: type) -> list[type]:
    found = []
    for kind in base.__subclasses__():
        found += _concrete(kind) + ([] if inspect.isabstract(kind) else [kind])
    return found


def _converter() -> Any:
    """A cattrs converter for records of options."""
    try:
        import cattrs
    except ImportError as error:
        raise ImportError('the command line needs cattrs: pip install "jaxloc[cli]"') from error
    converter = cattrs.Converter(forbid_extra_keys=True)
    for kind, convert in ((bool, _to_bool), (int, _to_int), (float, _to_float), (str, _to_str)):
        converter.register_structure_hook(kind, convert)
    converter.register_structure_hook_func(_is_array, _to_array)
    converter.register_structure_hook_func(_is_tuple, lambda value, kind: _to_tuple(converter, value, kind))
    converter.register_structure_hook_func(_is_choice, lambda value, base: _to_choice(converter, value, base))
    return converter


def _is_choice(kind: Any) -> bool:
    """Whether a field holds one of several records: its declared type is abstract."""
    return isinstance(kind, type) and dataclasses.is_dataclass(kind) and inspect.isabstract(kind)


def _to_choice(converter: Any, value: dict[str, Any], base: type) -> Any:
    options = {name: item for name, item in value.items() if name != TYPE}
    return converter.structure(options, _choices(base, "", value[TYPE]))


def _is_tuple(kind: Any) -> bool:
    return typing.get_origin(kind) is tuple


def _to_tuple(converter: Any, value: Any, kind: Any) -> tuple[Any, ...]:
    kinds = typing.get_args(kind)
    if not isinstance(value, list) or len(value) != len(kinds):
        raise _Invalid(f"is {_short(value)}, must be a list of {len(kinds)} values")
    return tuple(converter.structure(item, one) for item, one in zip(value, kinds, strict=True))


def _is_array(kind: Any) -> bool:
    """Whether a field holds an array, or a number or an array."""
    kinds = typing.get_args(kind) or (kind,)
    return any(hasattr(one, "array_type") for one in kinds) and type(None) not in kinds


def _to_array(value: Any, kind: Any) -> Any:
    if float in typing.get_args(kind) and isinstance(value, int | float):
        return _to_float(value, float)
    import jax.numpy as jnp

    try:
        table = np.array(value, dtype=object)
    except ValueError:
        raise _Invalid(f"is {_short(value)}, must be a number or an even table of numbers") from None
    numbers = [_to_float(number, float) for number in table.ravel().tolist()]
    array = jnp.asarray(np.reshape(numbers, table.shape), jnp.result_type(float))
    if not any(isinstance(array, one) for one in typing.get_args(kind) or (kind,)):
        raise _Invalid(f"is {_short(value)}, which has the wrong shape")
    return array


def _to_bool(value: Any, _: Any) -> bool:
    if not isinstance(value, bool):
        raise _Invalid(f"is {_short(value)}, must be true or false")
    return value


def _to_int(value: Any, _: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise _Invalid(f"is {_short(value)}, must be a whole number")
    if abs(value) >= 2**63:
        raise _Invalid(f"is {_short(value)}, must fit into 64 bits")
    return value


def _to_float(value: Any, _: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise _Invalid(f"is {_short(value)}, must be a number")
    if abs(value) > 1e300 or not math.isfinite(value):
        raise _Invalid(f"is {_short(value)}, must be finite")
    return float(value)


def _to_str(value: Any, _: Any) -> str:
    if not isinstance(value, str):
        raise _Invalid(f"is {_short(value)}, must be a word")
    return value


def _short(value: Any) -> str:
    text = " ".join(repr(value).split()) if not isinstance(value, int) or abs(value) < 2**63 else "a huge number"
    return text if len(text) <= 60 else f"{text[:60]}..."


def _first_line(error: BaseException) -> str:
    """The first of the errors that cattrs found, with the name of its option."""
    import cattrs

    lines = cattrs.transform_error(error, format_exception=_describe)
    text, _, place = lines[0].rpartition(" @ ")
    name = place.removeprefix("$").removeprefix(".").replace("['", ".").replace("']", "")
    if text.startswith("\0"):
        return f"{name} {text[1:]}"
    return f"{name}: {text}" if name else text


def _describe(error: BaseException, _: Any) -> str:
    text = " ".join(str(error).split())
    if isinstance(error, _Invalid) and not text.startswith("no option"):
        return f"\0{text}"
    return text or type(error).__name__
