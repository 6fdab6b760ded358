"""Rows of the table of tracks."""

import numpy as np
import pytest

from jaxloc.data.tracking.tracks_csv import HEADER, format_track


def test_rows_have_the_columns_of_the_header():
    assert HEADER == "frame,id,x,y,z,vx,vy,vz,var_x,var_y,var_z,u,v"
    numbers = np.arange(3.0)
    for uv in ((), (1.0, 2.0)):
        for size in (2, 3):
            row = format_track(7, 2, numbers[:size], 2 * numbers[:size], 3 * numbers[:size], uv)
            named = dict(zip(HEADER.split(","), row.split(","), strict=True))
            assert named["frame"] == "7" and named["id"] == "2" and named["vy"] == "2" and named["var_y"] == "3"
            assert named["z"] == ("2" if size == 3 else "") and named["u"] == ("1" if uv else "")


@pytest.mark.parametrize("sizes", [(1, 1, 1, 2), (4, 4, 4, 2), (3, 2, 3, 2), (3, 3, 2, 2), (3, 3, 3, 1)])
def test_other_lengths_are_refused(sizes):
    with pytest.raises(ValueError, match="Give 3"):
        format_track(0, 1, *(np.zeros(size) for size in sizes))
