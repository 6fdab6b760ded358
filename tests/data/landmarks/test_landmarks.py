"""Readers of drives among landmarks: real recordings, small files made by hand, and hostile ones."""

import gzip

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.io

from jaxloc.data import DataError
from jaxloc.data.landmarks import read_factors, read_mrclam, read_ranging
from jaxloc.sensors import RangeBearingSensor, RangeSensor

MRCLAM_TRUTH_START = 1248272272.94
STEP = "ODOMETRY 0 1 1 0 0 0 0 0 0 0 0\n"


def write(folder, name, text):
    path = folder / name
    path.write_bytes(gzip.compress(text.encode()) if name.endswith(".gz") else text.encode())
    return path


@pytest.fixture
def mrclam(tmp_path):
    write(tmp_path, "Barcodes.dat", "# subject barcode\n1 5\n6 63\n7 25\n")
    write(tmp_path, "Landmark_Groundtruth.dat", "6 1.0 2.0 0.001 0.001\n7 -1.0 0.5 0.001 0.001\n")
    write(tmp_path, "Robot1_Odometry.dat.gz", "10.0 1.0 0.0\n11.0 0.0 1.0\n11.0 9.0 9.0\n13.0 0.0 0.0\n")
    write(tmp_path, "Robot1_Measurement.dat", "12.0 25 2.0 0.5\n10.5 63 1.0 -0.5\n11.0 5 1.0 0.0\n11.0 99 1.0 0.0\n")
    write(tmp_path, "Robot1_Groundtruth.dat", "10.0 0.0 0.0 0.0\n12.0 2.0 0.0 0.0\n")
    return tmp_path


def test_mrclam_steps_end_in_readings(mrclam):
    log = read_mrclam(mrclam, 1)
    assert log.start == 10.0 and log.names == (6, 7) and len(log) == 2
    np.testing.assert_allclose(log.times, [0.5, 2.0])
    assert log.readings.landmark.tolist() == [0, 1]
    np.testing.assert_allclose(log.readings.range, [1.0, 2.0])
    np.testing.assert_allclose(jnp.arctan2(log.readings.bearing.sin, log.readings.bearing.cos), [-0.5, 0.5], atol=1e-6)
    # From 0.5 s to 2 s: half a meter ahead, then a turn of one radian on the spot.
    np.testing.assert_allclose(log.increments.motion.translation[1], [0.5, 0.0], atol=1e-6)
    np.testing.assert_allclose(log.increments.motion.rotation.sin[1], np.sin(1.0), atol=1e-6)
    np.testing.assert_allclose(log.increments.dt, [0.0, 1.5])
    np.testing.assert_allclose(log.truth.translation[:, 0], [0.5, 2.0], atol=1e-6)
    assert log.truth_valid.tolist() == [True, True]
    assert log.first(1).times.shape == (1,)
    assert log.renumbered(np.array([1, 0])).readings.landmark.tolist() == [1, 0]


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("Barcodes.dat", "1 two\n", "no number"),
        ("Landmark_Groundtruth.dat", "6 1.0\n", "needs 5"),
        ("Robot1_Measurement.dat", "12.0 25 nan 0.5\n", "not finite"),
        ("Robot1_Measurement.dat", "12.0 99 1.0 0.5\n", "saw no landmark"),
        ("Robot1_Odometry.dat", "# nothing\n", "no odometry"),
    ],
)
def test_bad_mrclam_files_are_named(mrclam, name, text, message):
    write(mrclam, name, text)
    with pytest.raises(DataError, match=message):
        read_mrclam(mrclam, 1)


def test_damaged_and_missing_files(mrclam, tmp_path):
    (mrclam / "Robot1_Odometry.dat.gz").write_bytes(b"\x1f\x8bnonsense")
    with pytest.raises(DataError, match="cannot be unpacked"):
        read_mrclam(mrclam, 1)
    with pytest.raises(DataError, match="no such file"):
        read_mrclam(mrclam, 2)


@pytest.mark.recordings
def test_mrclam_recording_agrees_with_motion_capture(recordings, x64):
    log = read_mrclam(recordings / "mrclam1_robot1", 1, truth_start=MRCLAM_TRUTH_START)
    assert len(log.names) == 15 and int(log.truth_valid.sum()) == 1129  # counts of the recording's own notes
    log = log.first(1129)
    sensor = RangeBearingSensor(log.landmarks, 0.1, 0.1)
    expected = jax.vmap(sensor.expect)(log.truth, log.readings)
    assert np.median(np.abs(expected.range - log.readings.range)) == pytest.approx(0.075, abs=0.002)
    bearing_errors = jax.vmap(lambda a, b: a.local(b)[0])(expected.bearing, log.readings.bearing)
    assert np.median(np.abs(bearing_errors)) == pytest.approx(0.024, abs=0.001)


@pytest.mark.recordings
def test_plaza_recording_has_its_documented_bias(recordings, x64):
    log = read_ranging(recordings / "range_slam_plaza1", "Plaza1")
    assert len(log) == 3529 and bool(log.truth_valid.all()) and log.names == (0, 1, 5, 6)
    expected = jax.vmap(RangeSensor(log.landmarks, 1.0).expect)(log.truth, log.readings)
    errors = np.asarray(log.readings.range - expected.range)
    assert np.median(errors) == pytest.approx(2.85, abs=0.02)
    assert float(np.linalg.norm(log.increments.motion.translation, axis=1).sum()) == pytest.approx(1859, rel=0.1)


def test_ranges_without_a_survey(tmp_path):
    write(tmp_path, "A_DR.txt", "0.0 0.0 0.0\n1.0 1.0 0.0\n2.0 1.0 0.0\n")
    write(tmp_path, "A_TD.txt", "1.5 2 7 4.0\n0.5 2 3 5.0\n9.0 2 3 5.0\n")
    log = read_ranging(tmp_path, "A")
    assert log.names == (3, 7) and log.readings.landmark.tolist() == [0, 1]
    assert np.isnan(log.landmarks).all() and not log.truth_valid.any()
    np.testing.assert_allclose(log.increments.motion.translation[1], [1.0, 0.0], atol=1e-6)
    write(tmp_path, "A_.mat", "not a MATLAB file, whatever its name says")
    with pytest.raises(DataError, match="MATLAB"):
        read_ranging(tmp_path, "A")
    write(tmp_path, "A_DR.txt", "0.0 0.0 0.0\n0.0 1.0 0.0\n")
    with pytest.raises(DataError, match="do not increase"):
        read_ranging(tmp_path, "A")


@pytest.mark.recordings
def test_victoria_park_recording(recordings):
    log = read_factors(recordings / "victoria_park" / "victoria_park.txt")
    assert (len(log), len(log.names)) == (3640, 151)


def test_factor_lists(tmp_path):
    path = write(
        tmp_path,
        "a.txt",
        f"{STEP}ODOMETRY 1 3 0 0 1.5 0 0 0 0 0 0\n\nLANDMARK 3 1 3 4 0 0 0\nLANDMARK 1 9 1 0 0 0 0\n",
    )
    log = read_factors(path)
    assert log.names == (1, 9) and log.readings.landmark.tolist() == [1, 0]
    np.testing.assert_allclose(log.readings.range, [1.0, 5.0])
    np.testing.assert_allclose(log.increments.motion.rotation.sin[1], np.sin(1.5), atol=1e-6)
    for text, message in (
        ("EDGE 1 2\n", "begins with 'EDGE'"),
        (STEP, "no ODOMETRY or no LANDMARK"),
        (
            f"{STEP}ODOMETRY 5 6 1 0 0 0 0 0 0 0 0\nLANDMARK 0 1 1 1 0 0 0\n",
            "begin at the pose",
        ),
        (f"{STEP}LANDMARK 7 1 1 1 0 0 0\n", "names a pose"),
        ("ODOMETRY 0 1 1\n", "needs 11"),
    ):
        with pytest.raises(DataError, match=message):
            read_factors(write(tmp_path, "b.txt", text))


@pytest.mark.parametrize("name", ["1e300", "0.5", "1e17"])
def test_names_are_whole_numbers(tmp_path, mrclam, name):
    with pytest.raises(DataError, match="too large|as the number of a landmark"):
        read_factors(write(tmp_path, "c.txt", f"{STEP}LANDMARK 1 {name} 1 1 0 0 0\n"))
    write(tmp_path, "A_DR.txt", "0 0 0\n1 1 0\n")
    write(tmp_path, "A_TD.txt", f"0.5 2 {name} 5\n")
    with pytest.raises(DataError, match="too large|as the number of a beacon"):
        read_ranging(tmp_path, "A")
    write(mrclam, "Barcodes.dat", f"6 {name}\n")
    with pytest.raises(DataError, match="too large|as the number of a"):
        read_mrclam(mrclam, 1)


def test_an_empty_ground_truth_is_none(mrclam):
    write(mrclam, "Robot1_Groundtruth.dat", "# nothing\n")
    assert not read_mrclam(mrclam, 1).truth_valid.any()


def test_a_survey_of_no_numbers_is_refused(tmp_path):
    write(tmp_path, "A_DR.txt", "0 0 0\n1 1 0\n")
    write(tmp_path, "A_TD.txt", "0.5 2 3 5\n")
    for truth, beacons, message in (
        (np.zeros((2, 4)), [[np.nan, 1, 2]], "not finite"),
        (np.array([[0.0, 0, 0, 0], [np.nan, 0, 0, 0]]), [[3.0, 1, 2]], "not finite"),
        (np.array([[0.0, 0, 0, 0], [1, 0, 0, 0]]), [[0.5, 1, 2]], "number of a beacon"),
        (np.array([[0.0, 0, 0, 0], [1, 0, 0, 0]], dtype=complex), [[3j, 1, 2]], "A_.mat"),
    ):
        scipy.io.savemat(tmp_path / "A_.mat", {"GT": truth, "TL": np.array(beacons)})
        with pytest.raises(DataError, match=message):
            read_ranging(tmp_path, "A")
