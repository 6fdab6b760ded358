"""YAML of options, as untrusted input: plain values only, bounded in size and depth, without aliases."""

import functools
from pathlib import Path
from typing import Any

from jaxloc.data import DataError
from jaxloc.data.io.text import read_text

_MOST_BYTES = 1 << 20
_DEEPEST = 20


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


def read_yaml(path: Path) -> Any:
    """Reads a YAML file.

    Args:
        path: the file, of at most 1 MiB.

    Returns:
        Its plain values.

    Raises:
        DataError: the file is missing, no regular file, too large, no text, or no plain YAML.
    """
    if path.exists():
        if not path.is_file():
            raise DataError(path, "is no file")
        if path.stat().st_size > _MOST_BYTES:
            raise DataError(path, f"has {path.stat().st_size} bytes: too large for a file of options")
    return parse_yaml(path, read_text(path))


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
    try:
        return load_yaml().load(text, Loader=_loader())
    except DataError:
        raise
    except ImportError:
        raise
    except Exception as error:  # YAMLError, and whatever the constructors of ill-formed values raise
        if type(error).__module__.startswith("yaml"):
            message = " ".join(str(error).split())
        else:
            message = f"a value that does not fit its tag ({type(error).__name__}: {error})"
        raise DataError(source, f"no valid YAML: {message[:300]}") from None


@functools.cache
def _loader() -> type:
    yaml = load_yaml()

    class Loader(yaml.SafeLoader):
        """A safe loader without aliases, deep nesting and repeated keys."""

        depth = 0

        def compose_node(self, parent: Any, index: Any) -> Any:
            """A node, at a bounded depth."""
            if self.check_event(yaml.events.AliasEvent):
                raise yaml.composer.ComposerError(None, None, "aliases are not allowed", self.peek_event().start_mark)
            self.depth += 1
            if self.depth > _DEEPEST:
                raise yaml.composer.ComposerError(None, None, "nested too deeply", self.peek_event().start_mark)
            node = super().compose_node(parent, index)
            self.depth -= 1
            return node

        def construct_mapping(self, node: Any, deep: bool = False) -> Any:
            """A mapping whose keys differ."""
            names = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
            repeated = {name for name in names if names.count(name) > 1}
            if repeated:
                where = node.start_mark
                raise yaml.constructor.ConstructorError(None, None, f"{min(repeated)} is given twice", where)
            return super().construct_mapping(node, deep)

    return Loader
