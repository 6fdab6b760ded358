"""Images: orientation, depth, largest values, damaged headers."""

import struct

import cv2
import numpy as np
import pytest

from jaxloc.data import DataError
from jaxloc.data.io import images
from jaxloc.data.io.image_header import parse_header

PICTURE = (np.arange(24 * 32) % 256).astype(np.uint8).reshape(24, 32)


def oriented_jpeg(orientation):
    data = cv2.imencode(".jpg", PICTURE)[1].tobytes()
    entry = struct.pack(">HHIHH", 274, 3, 1, orientation, 0)
    exif = b"Exif\0\0MM\0*\0\0\0\x08" + struct.pack(">H", 1) + entry + bytes(4)
    return data[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + data[2:]


@pytest.mark.parametrize("orientation", range(1, 9))
def test_orientation_is_that_of_imread(tmp_path, orientation):
    path = tmp_path / "a.jpg"
    path.write_bytes(oriented_jpeg(orientation))
    assert images.read_orientation(path) == orientation
    np.testing.assert_array_equal(images.read_gray(path), cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))
    np.testing.assert_array_equal(images.read_color(path), cv2.imread(str(path)))
    assert images.read_stored(path).shape == (24, 32, 1)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp", ".tif", ".webp", ".pgm", ".ppm"])
def test_sizes_are_known_before_images_are_decoded(suffix):
    image = np.dstack([PICTURE] * 3) if suffix == ".ppm" else PICTURE
    header = parse_header(cv2.imencode(suffix, image)[1].tobytes())
    assert (header.rows, header.columns, header.orientation) == (24, 32, 1)


@pytest.mark.parametrize("suffix", [".png", ".tif"])
@pytest.mark.parametrize(("white", "dtype"), [(4095, np.uint16), (65535, np.uint16), (255, np.uint8)])
def test_white_is_white_whatever_the_bits_are(tmp_path, suffix, white, dtype):
    ramp = np.linspace(0, white, 16).round().astype(dtype).reshape(4, 4)
    cv2.imwrite(str(tmp_path / f"a{suffix}"), ramp)
    cv2.imwrite(str(tmp_path / f"b{suffix}"), np.dstack([ramp] * 3))
    want = np.linspace(0, 255, 16).reshape(4, 4)
    np.testing.assert_allclose(images.read_gray(tmp_path / f"a{suffix}"), want, atol=1)
    np.testing.assert_allclose(images.read_color(tmp_path / f"b{suffix}")[..., 1], want, atol=1)


@pytest.mark.parametrize("form", ["P2", "P5", "P3", "P6"])
@pytest.mark.parametrize("white", [1, 15, 100, 255, 256, 4095, 65535])
def test_portable_maps_are_scaled_by_their_largest_value(tmp_path, form, white):
    ramp = np.linspace(0, white, 4).round().astype(int)
    channels = 3 if form in ("P3", "P6") else 1
    samples = np.repeat(ramp, channels)
    body = samples.astype(np.uint8 if white < 256 else ">u2").tobytes()
    if form in ("P2", "P3"):
        body = " ".join(map(str, samples)).encode()
    (tmp_path / "a.pnm").write_bytes(f"{form}\n# made by hand\n2 2 # size\n{white}\n".encode() + body)
    want = (255 * ramp / white).reshape(2, 2)
    np.testing.assert_allclose(images.read_gray(tmp_path / "a.pnm"), want, atol=1)
    np.testing.assert_allclose(images.read_color(tmp_path / "a.pnm")[..., 0], want, atol=1)


def test_colors_of_portable_maps_are_those_of_imread(tmp_path):
    path = tmp_path / "a.ppm"
    path.write_bytes(b"P6\n2 1\n255\n" + bytes([250, 10, 20, 1, 2, 3]))
    np.testing.assert_array_equal(images.read_color(path), cv2.imread(str(path)))
    np.testing.assert_allclose(images.read_gray(path), cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), atol=1)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"P5",
        b"P5\n2 2\n255\n\1",
        b"P5\n2 2\n0\n1234",
        b"P5\n2 2\n70000\n1234",
        b"P2\n2 2\n9\n1 2 3",
        b"P2\n2 2\n9\n1 2 3 x",
    ]
    + [
        b"P5\n0 2\n255\n",
        b"\xff\xd8\xff",
        b"\x89PNG\r\n\x1a\n",
        b"BM",
        b"II*\0",
        b"MM\0*\0\0\0\x08",
        b"RIFF",
        b"\0" * 99,
    ]
    + [oriented_jpeg(1)[:60]],
)
def test_damaged_images_are_refused(tmp_path, data):
    (tmp_path / "a").write_bytes(data)
    for read in (images.read_gray, images.read_color, images.read_stored):
        with pytest.raises(DataError, match="image") as caught:
            read(tmp_path / "a")
        assert "\n" not in str(caught.value)


def test_exif_blocks_that_lie_do_not_matter(tmp_path):
    data = bytearray(oriented_jpeg(6))
    place = data.index(b"MM\0*") + 4
    for value in (b"\xff\xff\xff\xff", b"\0\0\0\0"):
        data[place : place + 4] = value
        (tmp_path / "a.jpg").write_bytes(data)
        assert images.read_orientation(tmp_path / "a.jpg") == 1
        assert images.read_gray(tmp_path / "a.jpg").ndim == 2
