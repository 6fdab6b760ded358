"""CARMEN logs: what is read, from plain and compressed files, and what is refused."""

import bz2
import gzip
import io

import numpy as np
import pytest

from jaxloc.data import DataError, carmen


def flaser(time, x, ranges=(1.0, 2.0, 3.0, 4.0), mount=-0.1):
    words = [len(ranges), *ranges, x + mount, 0, 0, x, 0, 0, time, "host", time + 5]
    return "FLASER " + " ".join(str(word) for word in words) + "\n"


HEADER = "# comment\n\nPARAM robot_front_laser_max 55.5 0 host 0\nODOM 0 0 0 0 0 0 0.5 host 1\nSYNC a\n"
LOG = HEADER + "".join(flaser(float(index), 0.5 * index) for index in range(4))
ROBOTLASER = "ROBOTLASER1 0 -1.5 3.0 0.5 50 0.1 0 3 1 2 nan 2 7 8 {x} 0 0 {x} 0 0 0 0 0 0 0 {time} host {time}\n"


@pytest.mark.parametrize("pack", [bytes, gzip.compress, bz2.compress])
def test_flaser_lines(tmp_path, pack):
    path = tmp_path / "my.log"
    path.write_bytes(pack(LOG.encode()))
    log = carmen.read_log(path)
    assert log.name == "my" and len(log) == 4 and log.dropped == 0
    np.testing.assert_allclose(log.times, [0, 1, 2, 3])
    np.testing.assert_allclose(log.odometry[:, 0], [0, 0.5, 1, 1.5])
    np.testing.assert_allclose(log.ranges, np.tile([1, 2, 3, 4], (4, 1)))
    np.testing.assert_allclose(log.mount, [-0.1, 0, 0], atol=1e-12)
    assert log.max_range == 55.5 and log.corrected is None
    assert log.angle_min == pytest.approx(-np.pi / 2) and log.angle_increment == pytest.approx(np.pi / 4)
    scan = log.scans(slice(1, 3))
    assert scan.ranges.shape == (2, 4) and float(log.mount_pose().x) == pytest.approx(-0.1)


def test_robotlaser_lines_and_corrected_poses(tmp_path):
    path = tmp_path / "a.log"
    lines = [f"VERTEX2 {i} {2 * i} 1 0.5\n" + ROBOTLASER.format(x=i, time=float(i)) for i in range(3)]
    path.write_text("".join(lines) + "EDGE2 0 1 2\n")
    log = carmen.read_log(path)
    assert log.angle_min == -1.5 and log.angle_increment == 0.5 and log.max_range == 50
    assert np.isnan(log.ranges[:, 2]).all() and log.ranges[0, 1] == 2
    np.testing.assert_allclose(log.corrected, [[0, 1, 0.5], [2, 1, 0.5], [4, 1, 0.5]])


def test_a_laser_pose_that_leaves_the_robot_is_a_correction(tmp_path):
    path = tmp_path / "a.log"
    path.write_text("".join(flaser(float(i), 0.5 * i, mount=0.1 * i) for i in range(9)))
    log = carmen.read_log(path)
    np.testing.assert_allclose(log.corrected[:, 0], 0.6 * np.arange(9))
    assert log.mount == (0.0, 0.0, 0.0)


def test_scans_out_of_order_are_dropped(tmp_path):
    path = tmp_path / "a.log"
    path.write_text("".join(flaser(time, 0.0) for time in (0.0, 2.0, 1.0, 2.0, 3.0)))
    log = carmen.read_log(path)
    assert log.times.tolist() == [0.0, 2.0, 3.0] and log.dropped == 2
    path.write_text("".join(flaser(-time, 0.0) for time in range(5)))
    with pytest.raises(DataError, match="a.log: time goes backwards: only 1 of 5"):
        carmen.read_log(path)


@pytest.mark.parametrize(
    "text, match",
    [
        ("", "has no laser lines"),
        ("ODOM 0 0 0 0 0 0 0 h 0\n", "has no laser lines"),
        ("FLASER\n", "line 1 does not say how many ranges"),
        ("FLASER x 1\n", "line 1 does not say how many ranges"),
        ("FLASER 99999999 1\n", "line 1 claims 99999999 ranges"),
        ("FLASER -3 1\n", "line 1 claims -3 ranges"),
        ("FLASER 4 1 2 3 4 0 0 0 0 0\n", "line 1 is cut short"),
        ("FLASER 2 1 a 0 0 0 0 0 0 0 h 0\n", "line 1 holds a range that is no number"),
        ("FLASER 2 1 2 0 0 0 nan 0 0 0 h 0\n", "line 1 holds a number that is not finite"),
        ("FLASER 2 1 2 0 0 0 zero 0 0 0 h 0\n", "line 1 holds 'zero' where a number must be"),
        (flaser(0.0, 0.0) + flaser(1.0, 0.0, (1.0, 2.0)), "line 2 has 2 beams, the scans before it 4"),
        ("ROBOTLASER1 0 -1.5 3 0 50 0.1 0 1 1 0 " + "0 " * 14 + "\n", "line 1: angular step 0"),
        ("ROBOTLASER1 0 -1.5 3 0.1 50 0.1 0 1 1 0 0 0\n", "line 1 is cut short"),
        ("ROBOTLASER1 0\n", "line 1 is cut short"),
        ("FLASER " + "1 " * 600_000, "longer than"),
    ],
)
def test_bad_logs_are_refused(tmp_path, text, match):
    path = tmp_path / "a.log"
    path.write_text(text)
    with pytest.raises(DataError, match=match) as error:
        carmen.read_log(path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("pack", [gzip.compress, bz2.compress])
def test_damaged_files_are_refused(tmp_path, pack):
    path = tmp_path / "a.log.gz"
    path.write_bytes(pack(LOG.encode() * 20)[:-12])
    with pytest.raises(DataError, match="cannot be read"):
        carmen.read_log(path)
    path.write_bytes(b"\x1f\x8b" + b"no gzip at all")
    with pytest.raises(DataError, match="cannot be read"):
        carmen.read_log(path)
    with pytest.raises(DataError, match="no such file"):
        carmen.read_log(tmp_path / "nothing")
    with pytest.raises(DataError, match="cannot be read"):
        carmen.read_log(tmp_path)


def test_a_small_file_cannot_fill_the_memory(tmp_path):
    packed = io.BytesIO()
    with gzip.open(packed, "wb") as file:
        file.write(b"ODOM 0\n" * (1 << 21))
    path = tmp_path / "bomb.log.gz"
    path.write_bytes(packed.getvalue())
    with pytest.raises(DataError, match="holds more than 8 MiB"):
        carmen.read_log(path)


def test_binary_files_are_refused(tmp_path, rng):
    path = tmp_path / "a.log"
    path.write_bytes(rng.integers(0, 256, 5000, dtype=np.uint8).tobytes())
    with pytest.raises(DataError, match="has no laser lines"):
        carmen.read_log(path)


@pytest.mark.recordings
def test_a_real_log_is_that_of_the_keyframes(recordings):
    folder = recordings / "mcl_fr079"
    log = carmen.read_log(folder / "fr079.clf.bz2")
    keyframes = np.load(folder / "keyframes.npz")
    places = np.searchsorted(log.times, keyframes["stamp"])
    np.testing.assert_array_equal(log.ranges[places], keyframes["ranges"])
    np.testing.assert_array_equal(log.odometry[places], keyframes["odom"])
    np.testing.assert_allclose(log.mount, [-0.04, 0, 0], atol=1e-6)
    corrected = carmen.read_log(folder / "fr079_corrected.log.gz")
    np.testing.assert_allclose(corrected.corrected, keyframes["ref"], atol=1e-9)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-32"])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_the_first_message_is_read_in_any_encoding(tmp_path, encoding, end):
    lines = ["PARAM robot_front_laser_max 8.0", *(flaser(float(i), 0.5 * i).strip() for i in range(4))]
    for first in (0, 1):
        (tmp_path / "a.log").write_bytes(end.join(lines[first:]).encode(encoding))
        log = carmen.read_log(tmp_path / "a.log")
        assert len(log) == 4 and log.max_range == (81.0 if first else 8.0)


def test_ranges_that_cannot_be(tmp_path):
    path = tmp_path / "a.log"
    path.write_text("PARAM robot_front_laser_max -5 0 h 0\n" + LOG)
    with pytest.raises(DataError, match="line 1: greatest range -5 must be positive"):
        carmen.read_log(path)
    path.write_text("".join(f"FLASER 1 {word} 0 0 0 0 0 0 {i} h 0\n" for i, word in enumerate(("1", "1e39", "nan"))))
    log = carmen.read_log(path)
    assert log.ranges.shape == (3, 1) and log.angle_increment > 0 and np.isinf(log.ranges[1, 0])


def test_how_the_laser_is_mounted_is_said(tmp_path):
    path = tmp_path / "a.log"
    path.write_text(LOG)
    assert carmen.read_log(path).mounting == "The laser is mounted at (-0.1, 0) m, 0 degrees."
