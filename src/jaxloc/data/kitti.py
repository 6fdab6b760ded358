"""KITTI odometry sequences: images, calibration, time stamps and true poses.

::

    sequences/06/image_0/000000.png ...   left, gray     (or image_2 and image_3, color)
    sequences/06/image_1/000000.png ...   right, gray
    sequences/06/calib.txt                P0: and P1:, the 3x4 projection matrices of the rectified pair
    sequences/06/times.txt                one stamp a line, s
    poses/06.txt                          optional: 12 numbers a line, the rows of T_world_camera
"""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64

from jaxloc.data.io.errors import DataError
from jaxloc.data.io.files import is_folder
from jaxloc.data.io.offset import choose_offset, subtract_offset
from jaxloc.data.io.png import read_image, read_size, verify_image
from jaxloc.data.io.text import check_increasing, check_rotations, is_positive, parse_numbers, read_rows, read_text
from jaxloc.data.io.writing import write_file
from jaxloc.data.stereo_sequence import StereoFrame
from jaxloc.poses import Trajectory
from jaxloc.sensors import Pinhole, StereoRig


class KittiSequence(eqx.Module):
    """A stereo recording on disk; frames are read on demand. Made by :func:`read_sequence`.

    Attributes:
        name: of the folder.
        rig: the cameras.
        times: stamps, s.
        truth: true poses, positions relative to `offset`; None where not known.
        left_paths: images of the left camera.
        right_paths: images of the right camera.
        offset: (x, y, z) of the frame of the true poses in that of their file, of the same axes, m.
    """

    name: str
    rig: StereoRig
    times: Float64[np.ndarray, " n"]
    truth: Trajectory | None
    left_paths: tuple[Path, ...]
    right_paths: tuple[Path, ...]
    offset: Float64[np.ndarray, "3"]

    def __len__(self) -> int:
        return len(self.left_paths)

    def __getitem__(self, index: int) -> StereoFrame:
        left, right = read_image(self.left_paths[index]), read_image(self.right_paths[index])
        return StereoFrame(float(self.times[index]), left, right)

    def __iter__(self) -> Iterator[StereoFrame]:
        return (self[index] for index in range(len(self)))

    def verify(self, progress: Callable[[int], None] = lambda done: None) -> None:
        """Checks every byte of every image against its checksums, so that a long run does not end on a bad file.

        Args:
            progress: called with the number of frames checked.

        Raises:
            DataError: at the first image that is damaged.
        """
        for index in range(len(self)):
            verify_image(self.left_paths[index])
            verify_image(self.right_paths[index])
            progress(index + 1)


def read_sequence(folder: Path | str, poses: Path | str | None = None) -> KittiSequence:
    """Opens a stereo sequence, and checks everything about it that can be checked without decoding the images.

    Args:
        folder: the folder of the sequence, with ``image_0``, ``image_1``, ``calib.txt`` and ``times.txt``.
        poses: true poses, 12 numbers a line; where not given, ``../../poses/<name>.txt`` is read if it is there.

    Returns:
        The sequence. Its world frame is that of the poses file, at an offset where the floating-point type could not
        hold the coordinates to a millimeter.

    Raises:
        DataError: with one line that names the file or folder that is missing or wrong.
    """
    folder = Path(folder)
    if not is_folder(folder):
        raise DataError(folder, "no such folder")
    first, second = _camera_numbers(folder)
    left, right = (_list_images(folder / f"image_{number}") for number in (first, second))
    _check_pairs(left, right)
    rig = read_rig(folder / "calib.txt", left=first, right=second)
    times = read_times(folder / "times.txt")
    if len(times) != len(left):
        raise DataError(folder / "times.txt", f"has {len(times)} times for {len(left)} images")
    truth_path = _find_poses(folder) if poses is None else Path(poses)
    truth, offset = None, np.zeros(3)
    if truth_path is not None:
        matrices = _read_matrices(truth_path, len(times))
        offset = choose_offset(matrices[:, :3, 3])
        truth = _trajectory(truth_path, times, matrices, offset)
    return KittiSequence(folder.resolve().name, rig, times, truth, tuple(left), tuple(right), offset)


def _camera_numbers(folder: Path) -> tuple[int, int]:
    for first, second in ((0, 1), (2, 3)):
        if (folder / f"image_{first}").is_dir() or (folder / f"image_{second}").is_dir():
            return first, second
    raise DataError(folder, "has no image folders: needs image_0 and image_1 (or image_2 and image_3)")


def _list_images(folder: Path) -> list[Path]:
    if not is_folder(folder):
        raise DataError(folder, "no such folder")
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() == ".png")
    if not paths:
        raise DataError(folder, "empty sequence: the folder has no PNG images")
    return paths


def _check_pairs(left: list[Path], right: list[Path]) -> None:
    right_names, left_names = {path.name for path in right}, {path.name for path in left}
    for paths, others, folder in ((left, right_names, right[0].parent), (right, left_names, left[0].parent)):
        for path in paths:
            if path.name not in others:
                raise DataError(folder / path.name, f"no such image, though {path} is there")
    size = read_size(left[0])
    for path in left + right:
        other = read_size(path)
        if other != size:
            raise DataError(path, f"is {other[1]}x{other[0]} px, but {left[0].name} is {size[1]}x{size[0]} px")


def _find_poses(folder: Path) -> Path | None:
    path = folder.resolve().parent.parent / "poses" / f"{folder.resolve().name}.txt"
    return path if path.is_file() else None


def read_rig(path: Path | str, *, left: int = 0, right: int = 1) -> StereoRig:
    """Reads the rectified pair of cameras from a calibration file.

    The baseline is ``(P_left[0, 3] - P_right[0, 3]) / fx``, which is ``-P1[0, 3] / fx`` for the gray pair.

    Args:
        path: ``calib.txt``.
        left: number of the left camera.
        right: number of the right camera.

    Returns:
        The rig; lengths in m, focal lengths in px.

    Raises:
        DataError: when the file or a matrix is missing, malformed, or not of a rectified pair.
    """
    matrices = _read_projections(path)
    for number in (left, right):
        if f"P{number}" not in matrices:
            raise DataError(path, f"has no line P{number}:")
    first, second = matrices[f"P{left}"], matrices[f"P{right}"]
    fx, fy, cx, cy = first[0, 0], first[1, 1], first[0, 2], first[1, 2]
    if not (is_positive(fx) and is_positive(fy)):
        raise DataError(path, f"P{left}: focal lengths are {fx:g} and {fy:g} px, must be positive")
    expected = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    if not (np.allclose(first[:, :3], expected, atol=1e-6) and np.allclose(second[:, :3], expected, atol=1e-3)):
        raise DataError(path, f"P{left}: and P{right}: are not those of a rectified pair ([fx 0 cx; 0 fy cy; 0 0 1])")
    baseline = (first[0, 3] - second[0, 3]) / fx
    if not is_positive(baseline):
        raise DataError(path, f"the baseline from P{left}: and P{right}: is {baseline:g} m, must be positive")
    return StereoRig(Pinhole(*(float(value) for value in (fx, fy, cx, cy))), float(baseline))


def _read_projections(path: Path | str) -> dict[str, Float64[np.ndarray, "3 4"]]:
    matrices = {}
    for number, line in enumerate(read_text(path).split("\n"), start=1):
        name, colon, rest = line.partition(":")
        if colon and name.strip() in ("P0", "P1", "P2", "P3"):
            values = parse_numbers(path, number, rest.split(), 12)
            matrices[name.strip()] = np.array(values).reshape(3, 4)
    return matrices


def read_times(path: Path | str) -> Float64[np.ndarray, " n"]:
    """Reads stamps, one a line.

    Args:
        path: ``times.txt``.

    Returns:
        Increasing times, s.

    Raises:
        DataError: when the file is missing or malformed, or times do not increase.
    """
    times = read_rows(path, 1)[:, 0]
    check_increasing(path, times)
    return times


def read_poses(
    path: Path | str,
    *,
    times: Float64[np.ndarray, " n"] | None = None,
    offset: Sequence[float] = (0.0, 0.0, 0.0),
) -> Trajectory:
    """Reads poses, 12 numbers a line: the rows of ``[R t]`` of ``T_world_camera``.

    Args:
        path: the file.
        times: the stamps of the poses, s; where not given, the number of the frame.
        offset: (x, y, z) to subtract from positions, m.

    Returns:
        The path of the camera, with the rounding that the file has.

    Raises:
        DataError: when the file is missing or malformed, has no poses, not as many as there are times, or positions are
            too far from the offset to be held to a centimeter.
    """
    matrices = _read_matrices(path, None if times is None else len(times))
    if times is None:
        times = np.arange(len(matrices), dtype=np.float64)
    return _trajectory(path, times, matrices, offset)


def _read_matrices(path: Path | str, count: int | None) -> Float64[np.ndarray, "n 4 4"]:
    rows = read_rows(path, 12)
    if not len(rows):
        raise DataError(path, "has no poses")
    if count is not None and len(rows) != count:
        raise DataError(path, f"has {len(rows)} poses for {count} frames")
    matrices = np.tile(np.eye(4), (len(rows), 1, 1))
    matrices[:, :3] = rows.reshape(-1, 3, 4)
    check_rotations(path, matrices)
    return matrices


def _trajectory(
    path: Path | str,
    times: Float64[np.ndarray, " n"],
    matrices: Float64[np.ndarray, "n 4 4"],
    offset: Sequence[float] | np.ndarray,
) -> Trajectory:
    moved = matrices.copy()
    moved[:, :3, 3] = subtract_offset(path, matrices[:, :3, 3], offset)
    return Trajectory.from_matrices(jnp.asarray(times), jnp.asarray(moved))


def format_pose(matrix: np.ndarray) -> str:
    """Writes a pose as a KITTI row.

    Args:
        matrix: ``T_world_camera``, 4x4.

    Returns:
        12 numbers, without the line end.

    Example:
        >>> format_pose(np.eye(4)).split()[:2]
        ['1.000000000e+00', '0.000000000e+00']
    """
    return " ".join(f"{value:.9e}" for value in np.asarray(matrix, dtype=np.float64)[:3].ravel())


def write_poses(path: Path | str, trajectory: Trajectory) -> None:
    """Writes a path as KITTI rows, in one step.

    Args:
        path: the file.
        trajectory: the path of the camera.

    Raises:
        DataError: when the file cannot be written.
    """
    write_file(path, "".join(format_pose(matrix) + "\n" for matrix in np.asarray(trajectory.matrices())))
