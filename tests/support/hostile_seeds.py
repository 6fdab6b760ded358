"""A small valid file, or folder of files, for every reader: what the tests of hostile input begin with."""

import bz2
import gzip
import io
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import scipy.io

from jaxloc.cli import options
from jaxloc.data import (
    camera_file,
    carmen,
    covariance_csv,
    gtsam_stereo,
    kitti,
    road_images,
    ros_map,
    tum,
    wean_hall,
)
from jaxloc.data.io import images, png, text, yaml_file
from jaxloc.data.landmarks import read_factors, read_mrclam, read_ranging
from jaxloc.data.tracking import kitti_tracking, mot
from jaxloc.pipelines.calibration import Config


class Seed(NamedTuple):
    """Files by name, the one to mutate first, and what reads them from their folder."""

    files: dict[str, bytes]
    read: Callable[[Path], object]


def picture(suffix: str, *arguments: int) -> bytes:
    values = np.random.default_rng(0).integers(0, 256, (24, 32), dtype=np.uint8)
    return cv2.imencode(suffix, values, arguments)[1].tobytes()


def video() -> bytes:
    path = Path("/tmp") / f"jaxloc_seed_{np.random.default_rng().integers(1 << 60)}.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 20.0, (32, 24))
    for level in (20, 90):
        writer.write(np.full((24, 32, 3), level, np.uint8))
    writer.release()
    try:
        return path.read_bytes()
    finally:
        path.unlink()


def tables(**values: np.ndarray) -> bytes:
    file = io.BytesIO()
    scipy.io.savemat(file, values, do_compression=True)
    return file.getvalue()


POSE = "1 0 0 0.5 0 1 0 0.25 0 0 1 {}\n"
MATRIX = "camera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: [ 500., 0., 320., 0., 5e+02, "
MATRIX += "240., 0, 0, 1 ]\n"
CAMERA = (
    f"%YAML:1.0\n---\nimage_width: 640\nimage_height: 480\n{MATRIX}"
    "distortion_coefficients: !!opencv-matrix\n   rows: 5\n"
    "   cols: 1\n   dt: d\n   data: [ -0.3, .1, 1e-03, 0., 0. ]\nheight_m: 1.2\npitch_rad: 0.02\nroll_rad: 0.\n"
    "parameter_names: [ fx ]\nparameter_covariance: !!opencv-matrix\n   rows: 1\n   cols: 1\n   dt: d\n"
    "   data: [ 0.25 ]\n"
)
FLASER = "PARAM robot_front_laser_max 55.5 0 host 0\nODOM 0 0 0 0 0 0 0.5 host 1\n" + "".join(
    f"FLASER 3 1.5 2 8.1 {0.2 * i} 0 0.1 {0.2 * i} 0 0 {i} host {i}\n" for i in range(4)
)
ROBOTLASER = "".join(
    f"VERTEX2 {i} {2 * i} 1 0.5\nROBOTLASER1 0 -1.5 3.0 0.5 50 0.1 0 3 1 2 nan 2 7 8 {i} 0 0 {i} 0 0 "
    f"0 0 0 0 0 {i} host {i}\n"
    for i in range(3)
)
DETECTIONS = "".join(f"{i},2,10,20,30,40,0.{i},1.5,1.6,4.0,2.0,1.0,20.0,0.5,-1.5\n" for i in range(4))
LABELS = "".join(f"{i} 3 Car 0 0 -1.5 10 20 30 40 1.5 1.6 4.0 2.0 1.0 20.0 0.5\n" for i in range(4))
CALIBRATION = "".join(f"P{i}: 700 0 30 {-350 * i} 0 700 20 0 0 0 1 0\n" for i in range(4))
MOTIONS = (
    "R0_rect: 1 0 0 0 1 0 0 0 1\nTr_velo_to_cam: 1 0 0 0 0 1 0 0 0 0 1 0\nTr_imu_to_velo: 1 0 0 0 0 1 0 0 0 0 1 0\n"
)
BOXES = "".join(f"{i},7,10.5,20,5,6,0.{i},-1,-1,-1\n" for i in range(1, 5))
TRACKING = {
    "calib/1.txt": (CALIBRATION + MOTIONS).encode(),
    "orbslam3_poses/1.txt": "".join(map(POSE.format, range(5))).encode(),
    "det_pointrcnn_Car/1.txt": DETECTIONS.encode(),
    "label_02/1.txt": LABELS.encode(),
}
MAP = "image: m.{}\nresolution: 0.05\norigin: [-1.0, 2.0, 0.5]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
STEREO = {
    "VO_calibration00s.txt": b"700 710 0 320 240 0.5\n",
    "VO_camera_poses00s.txt": ("0 " + POSE.format(1)[:-1] + " 0 0 0 1\n").encode(),
    "VO_stereo_factors00s.txt": b"0 7 100 90 50 1 2 3\n0 9 101 90 50 1 2 3\n",
}
MRCLAM = {
    "Barcodes.dat": b"# subject barcode\n1 5\n6 63\n7 25\n",
    "Landmark_Groundtruth.dat": b"6 1.0 2.0 0.001 0.001\n7 -1.0 0.5 0.001 0.001\n",
    "Robot1_Odometry.dat.gz": gzip.compress(b"10.0 1.0 0.0\n11.0 0.0 1.0\n13.0 0.0 0.0\n", mtime=0),
    "Robot1_Measurement.dat": b"12.0 25 2.0 0.5\n10.5 63 1.0 -0.5\n11.0 5 1.0 0.0\n",
    "Robot1_Groundtruth.dat": b"10.0 0.0 0.0 0.0\n12.0 2.0 0.0 0.0\n",
}
RANGING = {
    "A_DR.txt": b"0.0 0.0 0.0\n1.0 1.0 0.1\n2.0 1.0 0.0\n",
    "A_TD.txt": b"1.5 2 7 4.0\n0.5 2 3 5.0\n",
    "A_.mat": tables(
        GT=np.array([[0.0, 0, 0, 0], [0.9, 1, 0, 0], [1.8, 2, 0, 0]]), TL=np.array([[3.0, 1, 2], [7, 3, 4]])
    ),
}
SEQUENCE = {
    "calib.txt": b"P0: 700 0 16 0 0 700 12 0 0 0 1 0\nP1: 700 0 16 -350 0 700 12 0 0 0 1 0\n",
    "times.txt": b"0.0\n0.1\n",
} | {f"image_{side}/{i}.png": picture(".png") for side in (0, 1) for i in (0, 1)}


def first(files: dict[str, bytes], name: str) -> dict[str, bytes]:
    """The same files, with another one to mutate."""
    return {name: files[name], **files}


def one(content: str | bytes, read: Callable[[Path], object], name: str = "a.txt") -> Seed:
    return Seed({name: content.encode() if isinstance(content, str) else content}, lambda folder: read(folder / name))


def sequence(folder: Path) -> object:
    found = kitti.read_sequence(folder)
    found.verify()
    return found.times, list(found)


def recording(path: Path) -> object:
    return list(road_images.open_recording(path))


SEEDS = {
    "kitti.read_rig": one(CALIBRATION, kitti.read_rig),
    "kitti.read_times": one("0.0\n0.1\n2e-1\n", kitti.read_times),
    "kitti.read_poses": one("".join(map(POSE.format, range(3))), kitti.read_poses),
    **{f"kitti.read_sequence {name}": Seed(first(SEQUENCE, name), sequence) for name in list(SEQUENCE)[:3]},
    "tum.read_trajectory": one("# t x y z q\n1.5 0 0 0 0 0 0 1\n2.5 1 0.5 0 0 0 0.6 0.8\n", tum.read_trajectory),
    "carmen.read_log": one(FLASER, carmen.read_log),
    "carmen.read_log ROBOTLASER1": one(ROBOTLASER, carmen.read_log),
    "carmen.read_log gzip": one(gzip.compress(FLASER.encode(), mtime=0), carmen.read_log),
    "carmen.read_log bzip2": one(bz2.compress(FLASER.encode()), carmen.read_log),
    "wean_hall.read_map": one("-1 1 1\n0 0.9 1\n", wean_hall.read_map),
    "wean_hall.read_log": one(f"L 1 2 0 3 2 0 {'25 ' * 180}0.2\nL 2 2 0 4 2 0 {'25 ' * 180}0.3\n", wean_hall.read_log),
    "covariance_csv.read_covariances": one(
        f"{covariance_csv.HEADER}\n{covariance_csv.format_covariance(1, np.eye(6))}\n", covariance_csv.read_covariances
    ),
    **{
        f"gtsam_stereo.read_stereo_factors {name}": Seed(first(STEREO, name), gtsam_stereo.read_stereo_factors)
        for name in STEREO
    },
    "factor_list.read_factors": one(
        "ODOMETRY 0 1 1 0 0.5 1 0 0 1 0 1\nODOMETRY 1 2 1 0 0 1 0 0 1 0 1\nLANDMARK 2 1 3 4 1 0 1\n", read_factors
    ),
    **{
        f"mrclam.read_mrclam {name}": Seed(first(MRCLAM, name), lambda folder: read_mrclam(folder, 1))
        for name in MRCLAM
    },
    **{
        f"ranging.read_ranging {name}": Seed(first(RANGING, name), lambda folder: read_ranging(folder, "A"))
        for name in RANGING
    },
    "kitti_tracking.read_detections": one(DETECTIONS, kitti_tracking.read_detections),
    "kitti_tracking.read_labels": one(LABELS, kitti_tracking.read_labels),
    "kitti_tracking.read_calibration": one(CALIBRATION + MOTIONS, kitti_tracking.read_calibration),
    "kitti_tracking.read_camera_poses": one("".join(map(POSE.format, range(3))), kitti_tracking.read_camera_poses),
    **{
        f"kitti_tracking.read_kitti_tracking {name}": Seed(
            {
                name: TRACKING[name],
                **{other: TRACKING[other] for other in TRACKING if not unposed or "poses" not in other},
            },
            lambda folder: kitti_tracking.read_kitti_tracking(folder, "1"),
        )
        for name, unposed in (("orbslam3_poses/1.txt", False), ("label_02/1.txt", True))
    },
    "mot.read_mot_detections": one(BOXES, mot.read_mot_detections),
    "mot.read_mot_tracks": one(BOXES, mot.read_mot_tracks),
    **{
        f"ros_map.read_map {name}": Seed(
            first({"m.yaml": MAP.format(suffix).encode(), f"m.{suffix}": content}, name),
            lambda folder: ros_map.read_map(folder / "m.yaml"),
        )
        for name, suffix, content in (
            ("m.yaml", "png", picture(".png")),
            ("m.png", "png", picture(".png")),
            ("m.pgm", "pgm", b"P5\n# map\n4 2\n200\n" + bytes(range(8))),
        )
    },
    "ros_map.read_offset": one(MAP.format("png"), ros_map.read_offset),
    "camera_file.read_camera": one(CAMERA, camera_file.read_camera),
    "png.read_image": one(picture(".png"), png.read_image),
    "png.read_size": one(picture(".png"), png.read_size),
    "png.verify_image": one(picture(".png"), png.verify_image),
    **{
        f"images.read_{kind} {name}": one(content, read)
        for name, content in (
            ("jpeg", picture(".jpg")),
            ("tiff", picture(".tif", cv2.IMWRITE_TIFF_COMPRESSION, 1)),
            ("bmp", picture(".bmp")),
            ("webp", picture(".webp")),
            ("binary pgm", b"P5\n4 2\n4000\n" + bytes(range(16))),
            ("plain ppm", b"P3\n# comment\n2 2\n15\n0 1 2 3 4 5 6 7 8 9 10 11\n"),
        )
        for kind, read in (
            ("gray", images.read_gray),
            ("color", images.read_color),
            ("stored", images.read_stored),
            ("orientation", images.read_orientation),
        )
    },
    "road_images.open_recording": one(picture(".jpg"), recording, "a.jpg"),
    "road_images.open_recording video": one(video(), recording, "a.avi"),
    "text.read_text": one("a\n", text.read_text),
    "text.read_rows": one("1 2\n3 4\n", lambda path: text.read_rows(path, 2)),
    "text.read_lines": one("1 2\n3 4\n", lambda path: list(text.read_lines(path))),
    "yaml_file.read_yaml": one("a: 1\nb: [1, 2.5]\n", lambda path: str(yaml_file.read_yaml(path))),
    "yaml_file.read_entries": one("a: 1\nb: [1, 2.5e3]\n", lambda path: str(yaml_file.read_entries(path, "map"))),
    "options.read_options": one(
        "radial: 2\ntangential: true\nrobust: 1.5\n", lambda path: options.read_options(Config(), path)
    ),
}
