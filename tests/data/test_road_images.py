"""Images, folders and videos of the road."""

import cv2
import numpy as np
import pytest

from jaxloc.data import DataError
from jaxloc.data.road_images import open_recording

SHAPE = (48, 64)


def picture(level):
    color = np.full((*SHAPE, 3), level, np.uint8)
    color[:10] = (0, 200, 220)  # yellow
    return color


@pytest.fixture
def folder(tmp_path):
    for number in (10, 9, 100):
        cv2.imwrite(str(tmp_path / f"f{number}.png"), picture(number))
    (tmp_path / "notes.txt").write_text("no image")
    return tmp_path


def write_video(path, levels, shape=SHAPE):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 20.0, shape[::-1])
    for level in levels:
        writer.write(np.full((*shape, 3), level, np.uint8))
    writer.release()


def test_folders_are_read_in_natural_order(folder):
    recording = open_recording(folder)
    frames = list(recording)
    assert [frame.name for frame in frames] == ["f9.png", "f10.png", "f100.png"]
    assert [frame.index for frame in frames] == [0, 1, 2] and len(recording) == 3 and not recording.is_video
    assert [int(frame.gray[20, 0]) for frame in frames] == [9, 10, 100]
    assert frames[0].gray[0, 0] == 210.0 and frames[0].gray.dtype == np.float32, "yellow is bright"
    np.testing.assert_array_equal(frames[1].color, picture(10))
    assert frames[0].time is None
    assert [f.index for f in recording] == [0, 1, 2], "it can be read again"


def test_a_single_picture(folder):
    (frame,) = open_recording(folder / "f10.png")
    assert frame.name == "f10.png" and frame.gray.shape == SHAPE


def test_videos_have_times(tmp_path):
    write_video(tmp_path / "road.avi", (20, 90, 160))
    recording = open_recording(tmp_path / "road.avi")
    assert recording.is_video and recording.rate == pytest.approx(20.0) and len(recording) == 3
    frames = list(recording)
    assert [frame.time for frame in frames] == pytest.approx([0.0, 0.05, 0.1])
    np.testing.assert_allclose([frame.gray.mean() for frame in frames], [20, 90, 160], atol=2)
    assert frames[2].name == "road.avi:2"


def test_bad_input_names_the_file(folder, tmp_path):
    def refuse(path, match):
        with pytest.raises(DataError, match=match) as caught:
            list(open_recording(path))
        return caught.value.path

    refuse(tmp_path / "nothing", "no such file or folder")
    empty = tmp_path / "empty"
    empty.mkdir()
    refuse(empty, "has no images")
    torn = tmp_path / "torn.mp4"
    torn.write_bytes(b"\x00\x00\x00\x18ftypmp42" + bytes(500))
    assert refuse(torn, "no video that can be decoded") == torn
    cv2.imwrite(str(folder / "f11.png"), np.zeros((10, 12, 3), np.uint8))
    assert refuse(folder, r"is 12x10, but the first image is 64x48").name == "f11.png"
    (folder / "f11.png").write_bytes(b"no image")
    assert refuse(folder, "no image that can be read").name == "f11.png"
    (folder / "f11.png").write_bytes(b"")
    refuse(folder / "f11.png", "no image that can be read")


def test_names_with_odd_digits_are_sorted(folder):
    cv2.imwrite(str(folder / "f².png"), picture(1))
    assert len(list(open_recording(folder))) == 4


def test_mixed_orientations_are_named(folder, tmp_path):
    exif = b"Exif\0\0MM\0*\0\0\0\x08\0\1\1\x12\0\3\0\0\0\1\0\3\0\0\0\0\0\0"
    data = cv2.imencode(".jpg", picture(5))[1].tobytes()
    (folder / "f101.jpg").write_bytes(data[:2] + b"\xff\xe1\0" + bytes([len(exif) + 2]) + exif + data[2:])
    with pytest.raises(DataError, match="f101.jpg: has the EXIF orientation 3, but the first image 1"):
        list(open_recording(folder))
