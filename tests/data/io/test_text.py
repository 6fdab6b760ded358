import bz2
import codecs
import gzip
import os

import numpy as np
import pytest

from jaxloc.data.io import text
from jaxloc.data.io.errors import DataError


def test_comments_empty_lines_and_commas_are_fine(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("# head\n1, 2\n\n3 4 # end\n")
    np.testing.assert_array_equal(text.read_rows(path, 2), [[1.0, 2.0], [3.0, 4.0]])
    path.write_text("")
    assert text.read_rows(path, 2).shape == (0, 2)


def test_errors_name_file_and_line(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("1 2\n1 x\n")
    with pytest.raises(DataError, match=r"a.txt: line 2 holds something that is no number") as caught:
        text.read_rows(path, 2)
    assert caught.value.path == path
    with pytest.raises(DataError, match="cannot be read"):
        text.read_text(tmp_path)
    with pytest.raises(DataError, match="row 3 is not later"):
        text.check_increasing(path, np.array([0.0, 1.0, 1.0]))
    with pytest.raises(DataError, match="row 2 is no pose"):
        text.check_rotations(path, np.stack([np.eye(4), np.diag([1.0, 1.0, -1.0, 1.0])]))


ENCODINGS = ("utf-8", "utf-8-sig", "utf-16", "utf-32")


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("pack", [bytes, gzip.compress, bz2.compress], ids=["plain", "gzip", "bzip2"])
def test_encodings_line_ends_and_packing_make_no_difference(tmp_path, encoding, end, pack):
    path = tmp_path / "a.txt"
    path.write_bytes(pack(end.join(["1 2", "# é", "", "3 4", ""]).encode(encoding)))
    np.testing.assert_array_equal(text.read_rows(path, 2), [[1.0, 2.0], [3.0, 4.0]])
    assert list(text.read_lines(path)) == [(1, ["1", "2"]), (4, ["3", "4"])]


@pytest.mark.parametrize("mark", [codecs.BOM_UTF16_BE, codecs.BOM_UTF32_BE])
def test_the_other_byte_order(tmp_path, mark):
    path = tmp_path / "a.txt"
    path.write_bytes(mark + "1 2\n".encode("utf-16-be" if len(mark) == 2 else "utf-32-be"))
    np.testing.assert_array_equal(text.read_rows(path, 2), [[1.0, 2.0]])


@pytest.mark.parametrize(
    ("word", "what"),
    [
        ("1e400", "not finite"),
        ("nan", "not finite"),
        ("1e39", "too large"),
        ("-1e39", "too large"),
        ("1_0", "no number"),
    ],
)
def test_numbers_that_single_precision_does_not_hold(tmp_path, word, what):
    (tmp_path / "a.txt").write_text(f"1 2\n3 {word}\n")
    with pytest.raises(DataError, match=f"line 2 holds .*{what}"):
        text.read_rows(tmp_path / "a.txt", 2)


def test_nanoseconds_are_no_seconds(tmp_path):
    text.check_increasing(tmp_path, np.array([1.7e9, 1.7e9 + 1]))
    with pytest.raises(DataError, match="nanoseconds"):
        text.check_increasing(tmp_path, np.array([1403636579763555584.0, 1403636579813555456.0]))


def test_special_files_and_names(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path, what in (
        (tmp_path / "pipe", "a pipe"),
        ("a\0b", "NUL"),
        ("/dev/zero", "a device"),
        ("a" * 5000, "cannot"),
    ):
        with pytest.raises(DataError, match=what) as caught:
            text.read_text(path)
        assert str(caught.value).isprintable() and len(str(caught.value)) < 900
