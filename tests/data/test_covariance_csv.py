import numpy as np
import pytest

from jaxloc.data import covariance_csv
from jaxloc.data.io.errors import DataError
from jaxloc.data.io.writing import RowWriter


def test_covariances_survive_a_round_trip(tmp_path, rng):
    roots = rng.standard_normal((5, 6, 6))
    matrices = roots @ np.swapaxes(roots, 1, 2)
    path = tmp_path / "covariance.csv"
    with RowWriter(path, covariance_csv.HEADER) as rows:
        for frame, matrix in enumerate(matrices):
            rows.append(covariance_csv.format_covariance(frame, matrix))
    np.testing.assert_allclose(covariance_csv.read_covariances(path), matrices, rtol=1e-5)
    table = np.loadtxt(path, delimiter=",", skiprows=2)
    np.testing.assert_allclose(table[:, 0], range(5))
    header = path.read_text().splitlines()
    assert "right perturbation" in header[0]
    assert header[1].split(",")[:3] == ["frame", "tx_tx", "tx_ty"] and header[1].split(",")[-1] == "rz_rz"


def test_bad_files_are_refused(tmp_path):
    path = tmp_path / "c.csv"
    path.write_text("1,2\n")
    with pytest.raises(DataError, match="no header"):
        covariance_csv.read_covariances(path)
    path.write_text(covariance_csv.HEADER + "\n0,1\n")
    with pytest.raises(DataError, match="line 3 has 2 numbers"):
        covariance_csv.read_covariances(path)
