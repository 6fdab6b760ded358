"""Camera files: OpenCV reads what is written and writes what is read; bad files are one clear line."""

import cv2
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.data import DataError
from jaxloc.data.camera_file import CameraFile, lens_names, read_camera, write_camera
from jaxloc.sensors import BrownConrady, KannalaBrandt, Pinhole

GOOD = """%YAML:1.0
---
image_width: 640
image_height: 480
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 500., 0., 320., 0., 510., 240., 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ -2.6637260909660682e-01, 1e-2, 0., 0., 0.2 ]
height_m: 1.2
pitch_rad: 2e-2
"""


def numbers(camera):
    return [float(value) for value in (camera.fx, camera.fy, camera.cx, camera.cy, camera.skew)]


def test_a_file_of_opencv(tmp_path, x64):
    path = tmp_path / "camera.yaml"
    matrix = np.array([[500.25, 0.0, 320.0], [0.0, 510.5, 240.125], [0.0, 0.0, 1.0]])
    coefficients = np.array([[-0.3, 0.1, 1e-3, -2e-4, 1.0 / 3.0]])
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("calibration_time", "Mon 1 Jan 2024 00:00:00")
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write("camera_matrix", matrix)
    storage.write("distortion_coefficients", coefficients)
    storage.write("grid_points", np.zeros((2, 3), np.float32))
    storage.write("height_m", 1.5)
    storage.release()
    read = read_camera(path)
    assert numbers(read.camera) == [500.25, 510.5, 320.0, 240.125, 0.0]
    np.testing.assert_array_equal(read.camera.lens.coefficients, coefficients[0])
    assert read.shape == (480, 640) and read.height == 1.5 and read.pitch is None and read.roll is None
    assert read.sigmas() == {}


def test_a_stereo_file_gives_the_left_camera(tmp_path):
    path = tmp_path / "intrinsics.yml"
    body = GOOD.replace("camera_matrix", "M1").replace("distortion_coefficients", "D1")
    path.write_text("\n".join(line for line in body.splitlines() if not line.startswith(("image", "height", "---"))))
    read = read_camera(path)
    assert numbers(read.camera)[:2] == [500.0, 510.0] and read.shape is None
    with pytest.raises(DataError, match="height_m"):
        read.require_height()
    with pytest.raises(DataError, match="image_width"):
        read.require_shape()


@pytest.mark.parametrize(
    ("kind", "coefficients"),
    [
        (None, ()),
        (BrownConrady, (-0.3, 0.1, 1e-3, -2e-4)),
        (BrownConrady, (-0.3, 0.1, 1e-3, -2e-4, 0.02)),
        (BrownConrady, (-0.3, 0.1, 1e-3, -2e-4, 0.02, 0.1, 0.2, 0.3)),
        (KannalaBrandt, (0.02, -0.01, 3e-3, 1e-4)),
    ],
    ids=["none", "4", "5", "8", "fisheye"],
)
def test_what_is_written_is_read_by_both(tmp_path, x64, kind, coefficients):
    path, lens = tmp_path / "camera.yaml", None if kind is None else kind(coefficients)
    camera = Pinhole(500.1, 510.2, 320.3, 240.4, 0.5, lens)
    names = ("fx", "fy", *lens_names(camera))
    covariance = np.diag(np.arange(1.0, len(names) + 1.0) / 3.0)
    write_camera(path, CameraFile(camera, (480, 640), 1.25, 0.02, -0.01, names, covariance))
    read = read_camera(path)
    assert numbers(read.camera) == numbers(camera) and type(read.camera.lens) is type(lens)
    assert (read.shape, read.height, read.pitch, read.roll) == ((480, 640), 1.25, 0.02, -0.01)
    assert read.names == names and read.sigmas()["fy"] == np.sqrt(2.0 / 3.0)
    np.testing.assert_array_equal(read.covariance, covariance)
    if lens is not None:
        np.testing.assert_array_equal(read.camera.lens.coefficients, lens.coefficients)

    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    np.testing.assert_array_equal(storage.getNode("camera_matrix").mat(), camera.matrix())
    expected = np.zeros(5) if lens is None else np.asarray(lens.coefficients)
    np.testing.assert_array_equal(storage.getNode("distortion_coefficients").mat().ravel(), expected)
    np.testing.assert_array_equal(storage.getNode("parameter_covariance").mat(), covariance)
    assert storage.getNode("image_width").real() == 640 and storage.getNode("height_m").real() == 1.25
    listed = storage.getNode("parameter_names")
    assert tuple(listed.at(i).string() for i in range(listed.size())) == names
    storage.release()


def test_precision_is_that_of_jax(tmp_path):
    path = tmp_path / "camera.yaml"
    path.write_text(GOOD)
    read = read_camera(path)
    assert read.camera.fx.dtype == jnp.float32 and read.camera.lens.coefficients.dtype == jnp.float32
    assert read.pitch == 0.02 and read.require_height() == 1.2


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ("camera_matrix", "kamera", "has no camera_matrix"),
        ("distortion_coefficients", "lens", "has no distortion_coefficients"),
        ("rows: 3", "rows: 4", "camera_matrix has 9 numbers, but rows: 4 and cols: 3"),
        ("rows: 3\n   cols: 3", "rows: 1\n   cols: 9", "camera_matrix is 1x9, must be 3x3"),
        ("rows: 3\n   cols: 3", "rows: -3\n   cols: -3", "camera_matrix has 9 numbers, but rows: -3"),
        ("rows: 3", "rows: [1]", "camera_matrix has 9 numbers"),
        ("   dt: d\n   data: [ 500.", "   dota: [ 500.", "camera_matrix is no matrix"),
        ("500.", ".nan", "camera_matrix holds a number that is not finite"),
        ("500.", "[1]", "camera_matrix holds something that is no number"),
        ("500.", "-500.", "focal lengths -500 and 510, must be positive"),
        ("510., 240.", "0., 240.", "focal lengths 500 and 0"),
        ("0., 0., 1. ]", "0., 0., 2. ]", "camera_matrix must have the rows"),
        ("rows: 5\n   cols: 1", "rows: 5\n   cols: 2", "distortion_coefficients has 5 numbers"),
        ("data: [ -2.6637260909660682e-01,", "data: [ .inf,", "distortion_coefficients holds a number that is not"),
        ("rows: 5\n   cols: 1", "rows: 6\n   cols: 1", "distortion_coefficients has 5 numbers"),
        ("height_m: 1.2", "height_m: 0", "height_m is 0, must be positive"),
        ("height_m: 1.2", "height_m: high", "height_m is 'high', must be a finite number"),
        ("pitch_rad: 2e-2", "pitch_rad: .nan", "pitch_rad is nan"),
        ("pitch_rad: 2e-2", "pitch_rad: 45", "pitch_rad is 45, must lie between"),
        ("image_width: 640", "image_width: -1", "image_width is -1, must be a positive whole number"),
        ("image_width: 640\n", "", "image_width is None"),
        ("height_m", "distortion_model: wavy\nheight_m", "distortion_model is 'wavy'"),
        ("height_m", "distortion_model: fisheye\nheight_m", "distortion_coefficients is 5x1, must be a row or column"),
        ("height_m", "parameter_covariance: [ 1. ]\nheight_m", "parameter_covariance is 1x1, but parameter_names"),
        ("!!opencv-matrix", "!!python/object:os.system", "no valid YAML"),
        ("%YAML:1.0\n---\n", "- ", "no valid YAML|is no camera file"),
        ("camera_matrix: !!opencv-matrix", "camera_matrix: !!opencv-matrix [1]\nmore:", "no valid YAML"),
    ],
)
def test_bad_files_are_one_clear_line(tmp_path, old, new, match):
    path = tmp_path / "camera.yaml"
    assert old in GOOD
    path.write_text(GOOD.replace(old, new, 1))
    with pytest.raises(DataError, match=match) as error:
        read_camera(path)
    assert str(error.value).startswith(f"{path}: ") and "\n" not in str(error.value)


def test_hostile_bytes(tmp_path, rng):
    path = tmp_path / "camera.yaml"
    with pytest.raises(DataError, match="no such file"):
        read_camera(path)
    path.write_text("")
    with pytest.raises(DataError, match="is no camera file"):
        read_camera(path)
    path.write_bytes(b"%YAML:1.0\n---\n" + b"[" * 100_000)
    with pytest.raises(DataError, match="no valid YAML"):
        read_camera(path)
    for _ in range(50):
        path.write_bytes(rng.integers(0, 256, 400, dtype=np.uint8).tobytes())
        with pytest.raises(DataError):
            read_camera(path)
        rubbish = bytearray(GOOD.encode())
        for place in rng.integers(0, len(rubbish), 30):
            rubbish[place] = rng.integers(32, 127)
        path.write_bytes(bytes(rubbish))
        try:
            read_camera(path)
        except DataError:
            pass


def test_an_unwritable_place(tmp_path):
    with pytest.raises(DataError, match="cannot be written"):
        write_camera(tmp_path / "no" / "camera.yaml", CameraFile(Pinhole(1.0, 1.0, 0.0, 0.0)))


@pytest.mark.recordings
def test_real_files(recordings):
    read = read_camera(recordings / "stereo_calib_opencv" / "left_intrinsics.yml")
    assert read.shape == (480, 640) and round(float(read.camera.fx), 2) == 535.92
    read = read_camera(recordings / "stereo_calib_opencv" / "intrinsics.yml")
    assert round(float(read.camera.cx), 3) == 335.686 and read.camera.lens.coefficients.shape == (5,)


BASE = (
    "camera_matrix: {{rows: 3, cols: 3, data: [5e+02, 0, '320', 0, 500., 240, 0, 0, 1]}}\ndistortion_coefficients: {}\n"
)


@pytest.mark.parametrize("count", [4, 5, 8, 12, 14])
def test_lenses_of_all_of_opencvs_models(tmp_path, count):
    path = tmp_path / "a.yaml"
    values = [-0.3, 0.1, 1e-3, 0.0, 0.0, 0.2, 0.0, 0.0][:count] + [0.0] * (count - 8)
    path.write_text(BASE.format(f"{{rows: 1, cols: {count}, data: {values}}}"))
    camera = read_camera(path).camera
    points = np.array([[0.2, -0.1, 1.0], [-0.3, 0.2, 1.0]])
    want, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.asarray(camera.matrix(), float), np.array(values))
    np.testing.assert_allclose(camera.project(jnp.asarray(points, float)), want[:, 0], atol=1e-3)


@pytest.mark.parametrize(("place", "name"), [(8, "s1"), (11, "s4"), (12, "tau_x"), (13, "tau_y")])
def test_lenses_that_are_not_supported_are_named(tmp_path, place, name):
    values = [0.0] * 14
    values[place] = 0.01
    (tmp_path / "a.yaml").write_text(BASE.format(values))
    with pytest.raises(DataError, match=f"{name} = 0.01: thin prisms and tilted sensors"):
        read_camera(tmp_path / "a.yaml")
