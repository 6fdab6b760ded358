"""Maps and logs of the particle-filter exercise."""

import gzip

import numpy as np
import pytest

from jaxloc.data import DataError, wean_hall


def test_rows_of_the_map_are_x(tmp_path):
    path = tmp_path / "map.txt.gz"
    path.write_bytes(gzip.compress(b"-1 1 1\n0 0.9 1\n"))
    grid = wean_hall.read_map(path)
    assert grid.probability.shape == (3, 2) and float(grid.resolution) == pytest.approx(0.1)
    assert np.argwhere(np.asarray(grid.occupied)).tolist() == [[0, 1]]
    assert not grid.free[0, 0] and int(grid.free.sum()) == 4
    for text, match in (("1 1\n1\n", "line 2 has 1 numbers"), ("", "is empty"), ("5 1\n", "neither -1 nor")):
        path.write_text(text)
        with pytest.raises(DataError, match=match):
            wean_hall.read_map(path)


def test_scans_are_in_meters(tmp_path):
    path = tmp_path / "log.txt"
    ranges = " ".join(["250"] * 180)
    path.write_text(f"O 1 2 3 0.1\nL 100 200 0 125 200 0 {ranges} 0.2\nL 110 200 0 135 200 0 {ranges} 0.3\n")
    log = wean_hall.read_log(path)
    np.testing.assert_allclose(log.odometry, [[1.0, 2.0, 0.0], [1.1, 2.0, 0.0]])
    np.testing.assert_allclose(log.ranges, 2.5)
    np.testing.assert_allclose(log.mount, [0.25, 0.0, 0.0])
    np.testing.assert_allclose(log.times, [0.2, 0.3])
    path.write_text("O 1 2 3 0.1\n")
    with pytest.raises(DataError, match="has no laser lines"):
        wean_hall.read_log(path)
    path.write_text("L 1 2 3\n")
    with pytest.raises(DataError, match="line 1 has 3 numbers"):
        wean_hall.read_log(path)
