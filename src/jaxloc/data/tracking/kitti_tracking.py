"""Sequences of the KITTI tracking benchmark: labels, detections of AB3DMOT, calibration and camera poses.

::

    label_02/0001.txt                frame, id, type, truncated, occluded, alpha, box (4), h w l, x y z, rotation_y
    det_pointrcnn_Car/0001.txt       frame, class (1 Pedestrian, 2 Car, 3 Cyclist), box (4), score, h w l, x y z,
                                     rotation_y, alpha; separated by commas
    calib/0001.txt                   P0: ... P3:, R0_rect, Tr_velo_to_cam, Tr_imu_to_velo
    orbslam3_poses/0001.txt          optional: 12 numbers a line, the rows of T_world_camera

Positions are those of the center of an object's bottom, in the rectified frame of camera 0.

References:
    Geiger, Lenz and Urtasun, "Are we ready for autonomous driving?", CVPR 2012. [T-44]
    Weng, Wang, Held and Kitani, "3D multi-object tracking: a baseline and new evaluation metrics", IROS 2020.
"""

from pathlib import Path

import equinox as eqx
import numpy as np
from jaxtyping import Float64

from jaxloc.data.io.errors import DataError
from jaxloc.data.io.files import is_folder
from jaxloc.data.io.text import (
    check_rotations,
    is_whole,
    parse_any_numbers,
    parse_numbers,
    read_rows,
    read_text,
)
from jaxloc.data.tracking.records import Detections, LabeledTracks, Rows, assemble, assemble_tracks, check_frame

TYPES = ("Car", "Van", "Truck", "Pedestrian", "Person", "Cyclist", "Tram", "Misc")
_ALIASES = {"Person_sitting": "Person"}
_IGNORED = "DontCare"
_CLASSES = {1: "Pedestrian", 2: "Car", 3: "Cyclist"}
_RATE = 10.0  # frames a second


class KittiCalibration(eqx.Module):
    """Cameras of the car.

    Attributes:
        projections: "4 3 4" of the rectified cameras 0 to 3, from the rectified frame of camera 0.
        rectification: "3 3", from camera 0 to its rectified frame.
        camera_velodyne: T_camera_velodyne, into the frame of camera 0 before it is rectified.
        velodyne_imu: T_velodyne_imu.
    """

    projections: Float64[np.ndarray, "4 3 4"]
    rectification: Float64[np.ndarray, "3 3"]
    camera_velodyne: Float64[np.ndarray, "4 4"]
    velodyne_imu: Float64[np.ndarray, "4 4"]


class KittiTracking(eqx.Module):
    """A sequence.

    Attributes:
        name: of the sequence.
        calibration: of the cameras.
        poses: T_world_camera of each frame; None where not known, and positions are then relative to the camera.
        detections: of a detector.
        truth: labels.
    """

    name: str = eqx.field(static=True)
    calibration: KittiCalibration
    poses: Float64[np.ndarray, "t 4 4"] | None
    detections: Detections
    truth: LabeledTracks


def read_kitti_tracking(
    folder: Path | str, name: str, *, detector: str = "det_pointrcnn_Car", types: tuple[str, ...] = ("Car",)
) -> KittiTracking:
    """Reads a sequence without its images.

    Args:
        folder: with the folders named above.
        name: of the sequence, such as ``0001``.
        detector: folder of the detections.
        types: of labels that are read.

    Returns:
        The sequence; as long as its poses, or as the longer of labels and detections.

    Raises:
        DataError: with one line that names the file, and the line of it, that is missing or wrong.
    """
    folder, file = Path(folder), f"{name}.txt"
    if not is_folder(folder):
        raise DataError(folder, "no such folder")
    calibration = read_calibration(folder / "calib" / file)
    posed = folder / "orbslam3_poses" / file
    poses = read_camera_poses(posed) if posed.exists() else None
    found, labels = folder / detector / file, folder / "label_02" / file
    if poses is None:
        length = max(len(read_detections(found)), len(read_labels(labels, types=TYPES).detections))
    else:
        length = len(poses)
    detections = read_detections(found, num_frames=length, poses=poses)
    truth = read_labels(labels, types=types, num_frames=length, poses=poses)
    return KittiTracking(name, calibration, poses, detections, truth)


def read_labels(
    path: Path | str,
    *,
    types: tuple[str, ...] = ("Car",),
    num_frames: int | None = None,
    poses: Float64[np.ndarray, "t 4 4"] | None = None,
) -> LabeledTracks:
    """Reads true tracks; regions marked ``DontCare`` are left out.

    Args:
        path: the file.
        types: that are read, of `TYPES`.
        num_frames: how many frames there are; up to the last line that is read where not given.
        poses: T_world_camera of each frame; the identity where not given.

    Returns:
        The tracks; the types of their detections are rows of `types`.

    Raises:
        DataError: the file is missing, a line is malformed or of an unknown type, or an identity occurs twice in a
            frame.
    """
    unknown = set(types) - set(TYPES)
    if unknown:
        raise ValueError(f"Labels have the types {', '.join(TYPES)}; it got {', '.join(sorted(unknown))}.")
    rows, kinds, lines = [], [], []
    for line, text in enumerate(read_text(path).split("\n"), start=1):
        words = text.split()
        if not words:
            continue
        if len(words) != 17:
            raise DataError(path, f"line {line} has {len(words)} words, needs 17")
        kind = _ALIASES.get(words[2], words[2])
        if kind != _IGNORED and kind not in TYPES:
            raise DataError(path, f"line {line}: {kind} is an unknown type of object")
        values = parse_numbers(path, line, words[:2] + words[3:], 16)
        check_frame(path, line, values[0], first=0)
        if kind in types:
            _check_identity(path, line, values[1])
            rows.append(values)
            kinds.append(types.index(kind))
            lines.append(line)
    values = np.array(rows, dtype=np.float64).reshape(len(rows), 16)
    scores = np.ones(len(rows))
    numbers = [np.array(column, dtype=np.int64) for column in (lines, values[:, 0], values[:, 1], kinds)]
    table = Rows(numbers[0], numbers[1], values[:, 5:9], scores, numbers[2], numbers[3], values[:, 9:16])
    return assemble_tracks(path, table, rate=_RATE, num_frames=num_frames, names=types, poses=poses)


def read_detections(
    path: Path | str,
    *,
    num_frames: int | None = None,
    capacity: int | None = None,
    poses: Float64[np.ndarray, "t 4 4"] | None = None,
) -> Detections:
    """Reads detections in AB3DMOT's format.

    Detections with non-finite values are left out and counted.

    Args:
        path: the file.
        num_frames: how many frames there are; up to the last line where not given.
        capacity: slots of a frame; the highest scores are kept.
        poses: T_world_camera of each frame; the identity where not given.

    Returns:
        The detections; their types are those of `TYPES`.

    Raises:
        DataError: when the file is missing, or a line is malformed or of an unknown class.
    """
    rows, lines = [], []
    for line, text in enumerate(read_text(path).split("\n"), start=1):
        words = text.replace(",", " ").split()
        if not words:
            continue
        if len(words) != 15:
            raise DataError(path, f"line {line} has {len(words)} numbers, needs 15")
        values = parse_any_numbers(path, line, words)
        check_frame(path, line, values[0], first=0)
        if values[1] not in _CLASSES:
            raise DataError(path, f"line {line}: {values[1]:g} is no class (1, 2 or 3)")
        rows.append(values)
        lines.append(line)
    values = np.array(rows, dtype=np.float64).reshape(len(rows), 15)
    kinds = np.array([TYPES.index(_CLASSES[int(value)]) for value in values[:, 1]], dtype=np.int64)
    frames = values[:, 0].astype(np.int64)
    boxes, scores, objects = values[:, 2:6], values[:, 6], values[:, 7:14]
    table = Rows(np.array(lines, dtype=np.int64), frames, boxes, scores, None, kinds, objects)
    return assemble(path, table, rate=_RATE, num_frames=num_frames, capacity=capacity, names=TYPES, poses=poses)


def read_camera_poses(path: Path | str) -> Float64[np.ndarray, "t 4 4"]:
    """Reads T_world_camera, 12 numbers a line.

    Args:
        path: the file.

    Returns:
        Matrices, in the precision of the file.

    Raises:
        DataError: when the file is missing, a line is malformed, or a block is no rotation.
    """
    rows = read_rows(path, 12)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = rows.reshape(-1, 3, 4)
    check_rotations(path, poses)
    return poses


def read_calibration(path: Path | str) -> KittiCalibration:
    """Reads the cameras of a sequence, under either of the names in use.

    Args:
        path: the file.

    Returns:
        The calibration.

    Raises:
        DataError: when the file, or a matrix, is missing or malformed.
    """
    matrices = {}
    for line, text in enumerate(read_text(path).split("\n"), start=1):
        name, *words = text.replace(":", " ", 1).split() or [""]
        if name:
            matrices[name] = np.array(parse_numbers(path, line, words, 9 if name.startswith("R") else 12))

    def find(*names: str) -> np.ndarray:
        for name in names:
            if name in matrices:
                return matrices[name].reshape(3, -1)
        raise DataError(path, f"has no line {names[0]}:")

    def motion(*names: str) -> np.ndarray:
        return np.vstack([find(*names), [0.0, 0.0, 0.0, 1.0]])

    projections = np.stack([find(f"P{number}") for number in range(4)])
    velodyne = motion("Tr_velo_to_cam", "Tr_velo_cam")
    return KittiCalibration(projections, find("R0_rect", "R_rect"), velodyne, motion("Tr_imu_to_velo", "Tr_imu_velo"))


def _check_identity(path: Path | str, line: int, value: float) -> None:
    if value < 0 or not is_whole(value):
        raise DataError(path, f"line {line}: {value:g} is no identity (whole, from 0)")
