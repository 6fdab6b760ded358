"""YAML as untrusted input: plain values only, bounded in size and depth, without aliases.

Numbers of options are those of YAML 1.1, as PyYAML reads them. Maps and cameras are written by programs that take other
words for numbers (``1e-05``), and quote some: there a number is what YAML 1.2 says (its core schema, section 10.3).
"""

import collections
import functools
import math
import re
from pathlib import Path
from typing import Any

from jaxloc.data.io.errors import DataError
from jaxloc.data.io.text import read_text

_MOST_BYTES = 1 << 18
_DEEPEST = 20
_NUMBER = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?|[-+]?\.inf|\.nan", re.ASCII | re.IGNORECASE)
_NUMBER_TAG, _MATRIX_TAG = "tag:yaml.org,2002:float", "tag:yaml.org,2002:opencv-matrix"


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
        raise ImportError('YAML files need pyyaml: pip install "jaxloc[cli]"') from error
    return yaml


def read_yaml(path: Path) -> Any:
    """Reads a YAML file.

    Args:
        path: the file, of at most 256 KiB.

    Returns:
        Its plain values.

    Raises:
        DataError: the file is missing, no regular file, too large, no text, or no plain YAML.
    """
    return parse_yaml(path, read_text(path, largest=_MOST_BYTES))


def read_entries(path: Path, what: str) -> dict[Any, Any]:
    """Reads a mapping with numbers as ROS and OpenCV write them; also OpenCV's matrices.

    Args:
        path: the file, of at most 256 KiB.
        what: that it describes, for the error.

    Returns:
        Its entries.

    Raises:
        DataError: as `read_yaml`, and when it is no mapping.
        ImportError: when pyyaml is not installed.
    """
    text = read_text(path, largest=_MOST_BYTES)
    if text.startswith("%YAML"):
        # OpenCV writes the version with a colon, which is no YAML.
        text = text.partition("\n")[2]
    entries = _parse(path, text, _number_loader())
    if not isinstance(entries, dict):
        raise DataError(path, f"is no {what}: it must be a mapping of names to values")
    return entries


def to_number(value: Any) -> float | None:
    """A number of a YAML file, also in quotes.

    Args:
        value: of an entry.

    Returns:
        The number, maybe not finite; None when the value is none.

    Example:
        >>> to_number("1e+03"), to_number(5), to_number("1_000"), to_number(True)
        (1000.0, 5.0, None, None)
    """
    if isinstance(value, str) and _NUMBER.fullmatch(value.strip()):
        return _to_float(value.strip())
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        return float(value)
    except OverflowError:
        return math.inf


def to_whole(value: Any) -> int | None:
    """A whole number of a YAML file, also in quotes; None when the value is none."""
    number = to_number(value)
    return None if number is None or abs(number) > 2**53 or number != math.floor(number) else int(number)


def describe(value: Any) -> str:
    """A value for an error message, cut short.

    Example:
        >>> describe(5.0), describe("a" * 90)[:5], describe(10**400)
        ('5', "'aaaa", 'a huge number')
    """
    if isinstance(value, int) and abs(value) > 2**63:
        return "a huge number"
    text = f"{value:g}" if isinstance(value, float) else repr(value)
    return text if len(text) <= 40 else f"{text[:40]}..."


def _to_float(word: str) -> float:
    word = word.lower()
    return float(word.replace(".inf", "inf").replace(".nan", "nan"))


def parse_yaml(source: Path | str, text: str) -> Any:
    """Parses YAML.

    Args:
        source: where it comes from, for the error.
        text: YAML.

    Returns:
        Its plain values.

    Raises:
        DataError: it is no YAML, nested too deeply, or has aliases, repeated keys or values of other types.
    """
    return _parse(source, text, _loader())


def _parse(source: Path | str, text: str, loader: type) -> Any:
    try:
        _check_structure(text)
        return load_yaml().load(text, Loader=loader)
    except DataError:
        raise
    except ImportError:
        raise
    except Exception as error:  # YAMLError, and whatever the constructors of ill-formed values raise
        if type(error).__module__.startswith("yaml"):
            message = " ".join(str(error).split())
            if "nesting depth" in message:  # of libyaml, which scans ahead
                message = "nested too deeply"
        else:
            message = f"a value that does not fit its tag ({type(error).__name__}: {error})"
        raise DataError(source, f"no valid YAML: {message[:300]}") from None


def _check_structure(text: str) -> None:
    """Refuses what would cost more than its length: aliases and deep nesting."""
    yaml, depth = load_yaml(), 0
    for event in yaml.parse(text, Loader=_base()):
        if isinstance(event, yaml.events.AliasEvent):
            raise yaml.composer.ComposerError(None, None, "aliases are not allowed", event.start_mark)
        if isinstance(event, yaml.events.CollectionStartEvent):
            depth += 1
        elif isinstance(event, yaml.events.CollectionEndEvent):
            depth -= 1
        if depth > _DEEPEST:
            raise yaml.composer.ComposerError(None, None, "nested too deeply", event.start_mark)


def _base() -> type:
    """The safe loader, in C where PyYAML has it: ten times as fast."""
    yaml = load_yaml()
    return getattr(yaml, "CSafeLoader", yaml.SafeLoader)


@functools.cache
def _loader() -> type:
    yaml = load_yaml()

    class Loader(_base()):
        """A safe loader without repeated keys."""

        def construct_mapping(self, node: Any, deep: bool = False) -> Any:
            """A mapping whose keys differ."""
            pairs = node.value if isinstance(node, yaml.MappingNode) else ()
            counts = collections.Counter(key.value for key, _ in pairs if isinstance(key, yaml.ScalarNode))
            name, count = counts.most_common(1)[0] if counts else ("", 1)
            if count > 1:
                where = node.start_mark
                raise yaml.constructor.ConstructorError(None, None, f"{name} is given twice", where)
            return super().construct_mapping(node, deep)

    return Loader


@functools.cache
def _number_loader() -> type:
    yaml = load_yaml()

    class NumberLoader(_loader()):
        """Numbers of YAML 1.2, and matrices of OpenCV as mappings with rows, cols and data."""

        yaml_implicit_resolvers = {
            first: [(tag, pattern) for tag, pattern in pairs if tag.rpartition(":")[2] in ("null", "bool", "merge")]
            for first, pairs in yaml.SafeLoader.yaml_implicit_resolvers.items()
        }

    pattern = re.compile(rf"^(?:{_NUMBER.pattern})$", re.ASCII | re.IGNORECASE)
    NumberLoader.add_implicit_resolver(_NUMBER_TAG, pattern, list("-+.0123456789"))
    NumberLoader.add_constructor(_NUMBER_TAG, lambda loader, node: _to_float(loader.construct_scalar(node)))
    NumberLoader.add_constructor(_MATRIX_TAG, lambda loader, node: loader.construct_mapping(node, True))
    return NumberLoader
