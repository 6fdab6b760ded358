"""Options of a pipeline as plain YAML and back."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from jaxloc.data import DataError
from jaxloc.data.io.text import read_text


def load_yaml() -> Any:
    """The YAML library.

    Returns:
        The module.

    Raises:
        ImportError: when it is not installed.
    """
    try:
        import yaml
    except ImportError as error:
        raise ImportError('the command line needs pyyaml: pip install "jaxloc[cli]"') from error
    return yaml


def to_plain(value: Any) -> Any:
    """Makes nested records, arrays and paths plain numbers, words, lists and mappings.

    Args:
        value: a record.

    Returns:
        What YAML and JSON can hold. A record that has no options is its name.
    """
    if dataclasses.is_dataclass(value):
        fields = {field.name: to_plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
        return fields or type(value).__name__
    if isinstance(value, dict):
        return {str(key): to_plain(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [to_plain(item) for item in value]
    if isinstance(value, bool | int | float | str) or value is None:
        return value
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "__array__"):
        return np.asarray(value).tolist()
    return getattr(value, "__name__", str(value))


def read_config(path: Path, default: Any) -> Any:
    """Reads options over the default ones.

    Args:
        path: YAML file: a mapping of options, or an earlier ``config.yaml``, whose part ``config`` counts.
        default: the record with the default options.

    Returns:
        A record of the same type.

    Raises:
        DataError: when the file is missing, malformed, or names an option that there is not.
    """
    yaml = load_yaml()
    try:
        data = yaml.safe_load(read_text(path))
    except yaml.YAMLError as error:
        raise DataError(path, f"no valid YAML: {' '.join(str(error).split())}") from None
    if isinstance(data, dict) and "config" in data:
        data = data["config"]
    return _update(path, default, {} if data is None else data, "")


def _update(path: Path, default: Any, data: Any, prefix: str) -> Any:
    if not isinstance(data, dict):
        raise DataError(path, f"{prefix.rstrip('.') or 'the file'} must be a mapping of options to values")
    names = [field.name for field in dataclasses.fields(default)]
    changes = {}
    for name, value in data.items():
        if name not in names:
            raise DataError(path, f"no option {prefix}{name}; there are {', '.join(names)}")
        changes[name] = _convert(path, getattr(default, name), value, f"{prefix}{name}")
    try:
        return dataclasses.replace(default, **changes)
    except (ValueError, TypeError) as error:
        raise DataError(path, " ".join(str(error).split())) from None


def _convert(path: Path, default: Any, value: Any, name: str) -> Any:
    """A value of the type that the default has."""
    if value == to_plain(default):
        return default
    if dataclasses.is_dataclass(default):
        return _update(path, default, value, f"{name}.")
    if isinstance(default, tuple) and isinstance(value, list):
        return tuple(value)
    if hasattr(default, "dtype") and isinstance(value, int | float) and not isinstance(value, bool):
        import jax.numpy as jnp

        return jnp.asarray(value, default.dtype)
    whole_to_real = isinstance(default, float) and type(value) is int
    if isinstance(default, float) and (whole_to_real or type(value) is float):
        if not np.isfinite(value):
            raise DataError(path, f"{name} is {value}, must be finite")
        return float(value)
    if type(value) is type(default) or (default is None and value is not None):
        return value
    raise DataError(path, f"{name} is {value!r}, must be like {to_plain(default)!r}")
