"""The YAML library, for what writes it; what reads it uses `jaxloc.data.io.yaml_file`."""

from jaxloc.data.io.yaml_file import load_yaml

__all__ = ["load_yaml"]
