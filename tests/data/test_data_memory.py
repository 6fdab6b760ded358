"""Files of at most 1 MB that ask for much: refused, or read with at most 300 MiB."""

import bz2
import gzip
import io
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
import scipy.io

from jaxloc.cli import options
from jaxloc.data import DataError, camera_file, carmen, gtsam_stereo, kitti, road_images, ros_map, wean_hall
from jaxloc.data.io import images, png
from jaxloc.data.landmarks import read_mrclam, read_ranging
from jaxloc.data.tracking import kitti_tracking, mot
from jaxloc.pipelines.calibration import Config

MOST = 300 << 20
MAP = b"resolution: 0.05\norigin: [0, 0, 0]\nimage: "
STATUS, RESET = Path("/proc/self/status"), Path("/proc/self/clear_refs")


def memory(name: str) -> int:
    line = next(line for line in STATUS.read_text().splitlines() if line.startswith(name))
    return int(line.split()[1]) << 10


def large_png(columns: int, rows: int, color: int = 0, bits: int = 8) -> bytes:
    """A white image that takes next to no space."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return len(data).to_bytes(4, "big") + kind + data + zlib.crc32(kind + data).to_bytes(4, "big")

    width = (columns * bits * {0: 1, 2: 3, 6: 4}[color]) // 8
    packer = zlib.compressobj(9)
    packed = b"".join(packer.compress(b"\0" + b"\xff" * width) for _ in range(rows)) + packer.flush()
    header = columns.to_bytes(4, "big") + rows.to_bytes(4, "big") + bytes([bits, color, 0, 0, 0])
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", packed) + chunk(b"IEND", b"")


def mat(shape: tuple[int, int]) -> bytes:
    file = io.BytesIO()
    scipy.io.savemat(file, {"GT": np.zeros(shape, np.uint8), "TL": np.zeros((1, 3))}, do_compression=True)
    return file.getvalue()


def read_map(folder: Path) -> object:
    (folder / "m.yaml").write_bytes(MAP + b"a.png\n")
    return ros_map.read_map(folder / "m.yaml")


def mrclam(folder: Path) -> object:
    for name, text in (("Barcodes.dat", "1 5\n6 63\n"), ("Landmark_Groundtruth.dat", "6 1 2 0 0\n")):
        (folder / name).write_text(text)
    (folder / "Robot1_Measurement.dat").write_text("0.5 63 1 0\n")
    return read_mrclam(folder, 1)


def ranging(folder: Path) -> object:
    (folder / "A_DR.txt").write_text("0 0 0\n1 1 0\n")
    (folder / "A_TD.txt").write_text("0.5 2 3 5\n")
    return read_ranging(folder, "A")


def gtsam(folder: Path) -> object:
    (folder / "VO_calibration00s.txt").write_text("700 710 0 320 240 0.5\n")
    (folder / "VO_camera_poses00s.txt").write_text("0 1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1\n")
    return gtsam_stereo.read_stereo_factors(folder)


def one(read, name="a.txt"):
    return name, lambda folder: read(folder / name)


BOX, SCAN = "{},-1,1,2,3,4,0.5\n", "FLASER 1 1 0 0 0 0 0 0 {} h 0\n"
OBJECT = "{},2,10,20,30,40,1,1.5,1.6,4.0,2,1,20,0.5,-1.5\n"
BOMBS = {
    "one late frame": (lambda: BOX.format(1) * 60 + BOX.format(999999), *one(mot.read_mot_detections)),
    "one late frame in 3-D": (
        lambda: OBJECT.format(1) * 60 + OBJECT.format(999999),
        *one(kitti_tracking.read_detections),
    ),
    "one full frame": (
        lambda: OBJECT.format(1) * 9000 + "".join(map(OBJECT.format, range(2, 9000))),
        *one(kitti_tracking.read_detections),
    ),
    "many identities": (
        lambda: "".join(f"{i},{i},1,2,3,4,1\n" for i in range(1, 45_000)),
        *one(mot.read_mot_tracks),
    ),
    "many cells": (lambda: large_png(20_000, 19_800), "a.png", read_map),
    "a large map": (lambda: large_png(5000, 5000), "a.png", read_map),
    "a large map in color": (lambda: large_png(5000, 5000, 6), "a.png", read_map),
    "a large map of 16 bits": (lambda: large_png(5000, 5000, 6, 16), "a.png", read_map),
    "a large picture": (lambda: large_png(5000, 5000, 2), *one(lambda p: list(road_images.open_recording(p)), "a.png")),
    "a large picture of 16 bits": (lambda: large_png(5000, 5000, 2, 16), *one(images.read_color, "a.png")),
    "a large gray picture": (lambda: large_png(12_000, 12_000), *one(images.read_gray, "a.png")),
    "a large image of a sequence": (lambda: large_png(12_000, 12_000), *one(png.read_image, "a.png")),
    "a declared size": (lambda: b"P5\n99999 99999\n255\n" + bytes(99), *one(images.read_gray)),
    "a declared size in words": (lambda: b"P2\n99999 99999\n255\n" + b"1 " * 99, *one(images.read_gray)),
    "aliases": (
        lambda: (
            "a0: &a0 [x, x]\n"
            + "".join(f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}]\n" for i in range(1, 30))
            + "image: *a29\n"
        ),
        *one(ros_map.read_map),
    ),
    "many entries": (lambda: "".join(f"a{i}: 1\n" for i in range(25_000)), *one(ros_map.read_map)),
    "a list below the limit": (lambda: "origin: [" + "1," * 131_000 + "]\n", *one(ros_map.read_map)),
    "a list of lists": (lambda: "[" + "[]," * 87_000 + "]\n", *one(ros_map.read_map)),
    "a long list": (lambda: "origin: [" + "1," * 490_000 + "]\nresolution: 1\n", *one(ros_map.read_map)),
    "a long list of a camera": (lambda: "M: [" + "1," * 490_000 + "]\n", *one(camera_file.read_camera)),
    "a long list of options": (
        lambda: "radial: [" + "1," * 490_000 + "]\n",
        *one(lambda path: options.read_options(Config(), path)),
    ),
    "a long number": (lambda: "resolution: 1" + "0" * 900_000 + "\n", *one(ros_map.read_map)),
    "packed scans": (lambda: gzip.compress(b"ODOM 0\n" * (1 << 24)), *one(carmen.read_log)),
    "packed scans by bzip2": (lambda: bz2.compress(b"ODOM 0\n" * (1 << 21)), *one(carmen.read_log)),
    "many scans": (lambda: "".join(map(SCAN.format, range(27_000))), *one(carmen.read_log)),
    "packed map": (
        lambda: gzip.compress(b"1 " * (1 << 18) + b"\n" + b"0 0 0 0\n" * (1 << 22)),
        *one(wean_hall.read_map),
    ),
    "packed row": (lambda: gzip.compress((b"1 " * (1 << 18) + b"\n") * 60), *one(wean_hall.read_map)),
    "packed odometry": (lambda: gzip.compress(b"1 0 0\n" * (1 << 25)), "Robot1_Odometry.dat.gz", mrclam),
    "packed factors": (lambda: gzip.compress(b"0 7 9 8 5 1 2 3\n" * (1 << 24)), "VO_stereo_factors00s.txt.gz", gtsam),
    "packed table": (lambda: mat((40_000, 4000)), "A_.mat", ranging),
    "many poses": (lambda: "1 0 0 0 0 1 0 0 0 0 1 0\n" * 41_000, *one(kitti.read_poses)),
}


@pytest.mark.parametrize("name", BOMBS)
def test_small_files_need_little_memory(tmp_path, name):
    make, file, read = BOMBS[name]
    content = make()
    content = content.encode() if isinstance(content, str) else content
    assert len(content) <= 1_000_000
    (tmp_path / file).write_bytes(content)
    measured = RESET.exists()
    if measured:
        RESET.write_text("5")  # the peak counts from here
    before = memory("VmRSS") if measured else 0
    try:
        read(tmp_path)
    except DataError as error:
        assert len(str(error)) < 1000 + len(str(tmp_path)) and "\n" not in str(error)
    if measured:
        assert memory("VmHWM") - before < MOST


def test_plain_images_are_not_taken_for_large_ones(tmp_path):
    """A white picture of a few megapixels is small, and fine."""
    cv2.imwrite(str(tmp_path / "a.png"), np.full((3000, 4000), 255, np.uint8))
    assert images.read_gray(tmp_path / "a.png").shape == (3000, 4000)
