import gzip

import numpy as np
import pytest

from jaxloc.data import DataError
from jaxloc.data.gtsam_stereo import read_stereo_factors

POSE = "0 1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1\n"
FACTORS = "0 7 100 90 50 1 2 3\n4 7 101 90 50 1 2 3\n4 2 80 70 40 0 0 5\n"


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "VO_calibration00s.txt").write_text("700 710 0 320 240 0.5\n")
    (tmp_path / "VO_camera_poses00s.txt").write_text("4 1 0 0 2 0 1 0 0 0 0 1 0 0 0 0 1\n" + POSE)
    (tmp_path / "VO_stereo_factors00s.txt").write_text(FACTORS)
    return tmp_path


def check_small(bundle):
    assert bundle.camera_numbers.tolist() == [0, 4] and bundle.point_numbers.tolist() == [2, 7]
    assert bundle.observations.camera.tolist() == [0, 1, 1] and bundle.observations.point.tolist() == [1, 1, 0]
    assert bundle.observations.measured.tolist() == [[100, 90, 50], [101, 90, 50], [80, 70, 40]]
    # Point 7 was seen first by camera 0, point 2 by camera 4, two meters to the right.
    assert bundle.start.points.tolist() == [[2, 0, 5], [1, 2, 3]]
    assert bundle.start.poses.translation.tolist() == [[0, 0, 0], [2, 0, 0]]
    assert float(bundle.rig.camera.fy) == 710.0 and float(bundle.rig.baseline) == 0.5


def test_small_bundle_is_read(folder, dtype):
    bundle = read_stereo_factors(folder)
    check_small(bundle)
    assert bundle.observations.measured.dtype == bundle.start.points.dtype == dtype


def test_packed_file_is_read(folder):
    plain = folder / "VO_stereo_factors00s.txt"
    plain.with_name(plain.name + ".gz").write_bytes(gzip.compress(plain.read_bytes()))
    plain.unlink()
    check_small(read_stereo_factors(folder))


@pytest.mark.parametrize(
    "file, text, message",
    [
        ("calibration", "700 710 0 320 240", "line 1 has 5 numbers, needs 6"),
        ("calibration", "700 0 0 320 240 0.5", "must be positive"),
        ("calibration", "", "is empty"),
        ("calibration", "700 710 0 320 240 0.5\n" * 2, "has 2 rows"),
        ("camera_poses", "0 2 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1", "not a rotation"),
        ("camera_poses", "0 1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 2", "not 0 0 0 1"),
        ("camera_poses", "0.5" + POSE[1:], "number of a camera"),
        ("camera_poses", POSE * 2, "two poses of one camera"),
        ("camera_poses", POSE, "row 2 names camera 4, which has no pose"),
        ("stereo_factors", "0 7 100 90 nan 1 2 3", "not finite"),
        ("stereo_factors", "0 7 100 90 x 1 2 3", "no number"),
        ("stereo_factors", "0 1e17 100 90 50 1 2 3", "number of a point"),
        ("stereo_factors", "0 7 90 90 50 1 2 3", "no positive disparity"),
        ("stereo_factors", "0 1e300 100 90 50 1 2 3", "too large"),
    ],
)
def test_bad_files_are_named(folder, file, text, message):
    path = folder / f"VO_{file}00s.txt"
    path.write_text(text)
    with pytest.raises(DataError, match=message) as raised:
        read_stereo_factors(folder)
    assert raised.value.path.name.startswith("VO_")


@pytest.mark.parametrize(
    "content",
    [b"plain", gzip.compress(FACTORS.encode())[:-9], gzip.compress(b"\xff\xfe\xfa")],
    # Packed bytes hold the time: as names of tests they would differ between the processes that run them.
    ids=["plain", "truncated", "no text"],
)
def test_bad_packed_files_are_named(folder, content):
    (folder / "VO_stereo_factors00s.txt").unlink()
    (folder / "VO_stereo_factors00s.txt.gz").write_bytes(content)
    with pytest.raises(DataError, match="VO_stereo_factors00s.txt.gz"):
        read_stereo_factors(folder)


def test_missing_files_are_named(folder):
    with pytest.raises(DataError, match="no such folder"):
        read_stereo_factors(folder / "nowhere")
    with pytest.raises(DataError, match="VO_calibration07.txt: no such file"):
        read_stereo_factors(folder, "07")


@pytest.mark.recordings
def test_recording_is_consistent(recordings, x64):
    bundle = read_stereo_factors(recordings / "stereo_vo_factors_gtsam")
    seen = bundle.observations
    assert seen.measured.shape == (52544, 3) and bundle.start.points.shape == (15638, 3)
    assert bundle.start.poses.batch_shape == (77,)
    first = np.unique(seen.point, return_index=True)[1]
    pose, points = bundle.start.poses, bundle.start.points
    rotations = np.asarray(pose.rotation.rotation_matrix)[np.asarray(seen.camera)[first]]
    arms = np.asarray(points) - np.asarray(pose.translation)[np.asarray(seen.camera)[first]]
    local = np.einsum("nij,ni->nj", rotations, arms)
    np.testing.assert_allclose(bundle.rig.project(local), np.asarray(seen.measured)[first], atol=0.05)
