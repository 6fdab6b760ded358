import pytest

from jaxloc.data.io.errors import DataError
from jaxloc.data.io.writing import RowWriter, write_file


def test_write_file_replaces_and_leaves_nothing_else(tmp_path):
    path = tmp_path / "a.txt"
    write_file(path, "old")
    write_file(path, b"new")
    assert path.read_bytes() == b"new"
    assert [file.name for file in tmp_path.iterdir()] == ["a.txt"]


def test_write_file_names_the_file_that_cannot_be_written(tmp_path):
    with pytest.raises(DataError, match=r"missing/a.txt: cannot be written"):
        write_file(tmp_path / "missing" / "a.txt", "x")


def test_rows_take_their_place_when_the_block_ends(tmp_path):
    path = tmp_path / "rows.csv"
    path.write_text("before")
    with RowWriter(path, header="a,b") as rows:
        rows.append("1,2")
        assert path.read_text() == "before"
    assert path.read_text() == "a,b\n1,2\n"
    assert [file.name for file in tmp_path.iterdir()] == ["rows.csv"]


@pytest.mark.parametrize("error, kept", [(KeyboardInterrupt, "1\n2\n"), (RuntimeError, "before")])
def test_an_interrupt_keeps_rows_and_an_error_keeps_the_old_file(tmp_path, error, kept):
    path = tmp_path / "rows.txt"
    path.write_text("before")
    with pytest.raises(error), RowWriter(path) as rows:
        rows.append("1")
        rows.append("2")
        raise error
    assert path.read_text() == kept
    assert [file.name for file in tmp_path.iterdir()] == ["rows.txt"]


def test_an_interrupt_before_the_first_row_keeps_the_old_file(tmp_path):
    path = tmp_path / "rows.txt"
    path.write_text("before")
    with pytest.raises(KeyboardInterrupt), RowWriter(path, header="a"):
        raise KeyboardInterrupt
    assert path.read_text() == "before"
    assert [file.name for file in tmp_path.iterdir()] == ["rows.txt"]


def test_names_that_are_not_unicode_are_written_with_escapes(tmp_path):
    write_file(tmp_path / "a", "x\udcff")
    with RowWriter(tmp_path / "b") as rows:
        rows.append("x\udcff")
    assert (tmp_path / "a").read_text() == (tmp_path / "b").read_text()[:-1] == "x\\udcff"


def test_rows_are_refused_outside_the_block(tmp_path):
    with pytest.raises(ValueError, match="not open"):
        RowWriter(tmp_path / "a").append("1")
    with pytest.raises(DataError, match="cannot be written"), RowWriter(tmp_path / "no" / "a"):
        pass
