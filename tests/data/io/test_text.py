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
