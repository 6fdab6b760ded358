import cv2
import numpy as np
import pytest

from jaxloc.data.io.errors import DataError
from jaxloc.data.io.png import read_image, read_size, verify_image


@pytest.fixture
def path(tmp_path, rng):
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), rng.integers(0, 256, (40, 60), dtype=np.uint8))
    return path


def test_image_and_size_match_opencv(path):
    assert read_size(path) == (40, 60)
    np.testing.assert_array_equal(read_image(path), cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))
    verify_image(path)


def test_color_becomes_gray(tmp_path, rng):
    path = tmp_path / "c.png"
    cv2.imwrite(str(path), rng.integers(0, 256, (10, 12, 3), dtype=np.uint8))
    image = read_image(path)
    assert image.shape == (10, 12) and image.dtype == np.uint8


@pytest.mark.parametrize("fraction", [0.02, 0.3, 0.7, 0.95, 0.999])
def test_a_truncated_image_is_refused_wherever_it_is_cut(path, fraction):
    data = path.read_bytes()
    path.write_bytes(data[: int(fraction * len(data))])
    for function in (read_image, read_size, verify_image):
        with pytest.raises(DataError, match=r"a\.png: truncated PNG"):
            function(path)


def test_a_damaged_byte_is_found(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0x10
    path.write_bytes(bytes(data))
    with pytest.raises(DataError, match="damaged PNG"):
        verify_image(path)


@pytest.mark.parametrize("data, what", [(b"", "empty file"), (b"\xff\xd8\xff\xe0" * 20, "not a PNG")])
def test_other_files_are_refused(tmp_path, data, what):
    path = tmp_path / "x.png"
    path.write_bytes(data)
    for function in (read_image, read_size, verify_image):
        with pytest.raises(DataError, match=what):
            function(path)


def test_missing_images_and_folders_are_named(tmp_path):
    for function in (read_image, read_size):
        with pytest.raises(DataError, match="nope.png: no such image"):
            function(tmp_path / "nope.png")
        with pytest.raises(DataError, match="cannot be read"):
            function(tmp_path)
