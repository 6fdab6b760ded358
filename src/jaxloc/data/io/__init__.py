"""Text files, PNG images and atomic writing."""

from jaxloc.data.io import errors, png, text, writing
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
    "parse_numbers",
    "png",
    "read_image",
    "read_rows",
    "read_size",
    "read_text",
    "text",
    "verify_image",
    "write_file",
    "writing",
]
