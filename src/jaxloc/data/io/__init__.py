"""Text files, YAML, images and atomic writing, with bounds on what a hostile file can cost."""

from jaxloc.data.io import errors, files, image_header, images, png, portable_map, text, writing, yaml_file
from jaxloc.data.io.errors import DataError
from jaxloc.data.io.png import read_image, read_size, verify_image
from jaxloc.data.io.text import check_increasing, check_rotations, parse_numbers, read_rows, read_text
from jaxloc.data.io.writing import RowWriter, write_file

__all__ = [
    "DataError",
    "RowWriter",
    "check_increasing",
    "check_rotations",
    "errors",
    "files",
    "image_header",
    "images",
    "parse_numbers",
    "png",
    "portable_map",
    "read_image",
    "read_rows",
    "read_size",
    "read_text",
    "text",
    "verify_image",
    "write_file",
    "writing",
    "yaml_file",
]
