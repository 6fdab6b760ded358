"""Stereo bundles in GTSAM's text format of stereo factors.

::

    VO_calibration00s.txt       fx fy skew cx cy baseline
    VO_camera_poses00s.txt      one a line: number of the camera, 16 numbers of T_world_camera, row by row
    VO_stereo_factors00s.txt    one a line: camera, point, u_left, u_right, v, and x y z of the point before that camera

Each may be packed, with ``.gz`` behind its name.
"""

from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64, Int64

from jaxloc.data.io.errors import DataError
from jaxloc.data.io.files import is_folder
from jaxloc.data.io.text import check_rotations, is_positive, read_rows, whole_numbers
from jaxloc.poses import SE3
from jaxloc.refinement.bundle import Bundle, Observations
from jaxloc.sensors import Pinhole, StereoRig


class StereoBundle(eqx.Module):
    """Stereo observations of points from many poses.

    Attributes:
        rig: the rig.
        start: poses of the left camera as the file has them, and points from where each was seen first.
        observations: (u_left, u_right, v), px; sigma is 1 px.
        camera_numbers: of the file, in the order of the poses.
        point_numbers: of the file, in the order of the points.
    """

    rig: StereoRig
    start: Bundle
    observations: Observations
    camera_numbers: Int64[np.ndarray, " c"]
    point_numbers: Int64[np.ndarray, " n"]


def read_stereo_factors(folder: Path | str, name: str = "00s") -> StereoBundle:
    """Reads a bundle of stereo factors.

    Args:
        folder: where the three files lie.
        name: what their names end with: ``VO_calibration<name>.txt`` and so on.

    Returns:
        The bundle; cameras in ascending order of their numbers, points too.

    Raises:
        DataError: when a file is missing or malformed, or the files do not fit each other.
    """
    folder = Path(folder)
    if not is_folder(folder):
        raise DataError(folder, "no such folder")
    rig = _read_rig(_find(folder, f"VO_calibration{name}.txt"))
    cameras, matrices = _read_cameras(_find(folder, f"VO_camera_poses{name}.txt"))
    path = _find(folder, f"VO_stereo_factors{name}.txt")
    rows = _read_rows(path, 8)
    camera, point = whole_numbers(path, rows[:, 0], "camera"), whole_numbers(path, rows[:, 1], "point")
    unknown = np.flatnonzero(~np.isin(camera, cameras))
    if unknown.size:
        raise DataError(path, f"row {unknown[0] + 1} names camera {camera[unknown[0]]}, which has no pose")
    flat = np.flatnonzero(~((rows[:, 2] > rows[:, 3]) & (rows[:, 7] > 0)))
    if flat.size:
        raise DataError(path, f"row {flat[0] + 1} has no positive disparity and depth")
    camera = np.searchsorted(cameras, camera)
    points, first, point = np.unique(point, return_index=True, return_inverse=True)
    poses = matrices[camera[first]]
    start = np.einsum("nij,nj->ni", poses[:, :3, :3], rows[first, 5:]) + poses[:, :3, 3]
    stack = jax.vmap(SE3.from_matrix)(jnp.asarray(matrices))
    observations = Observations.of(camera, point, rows[:, 2:5])
    return StereoBundle(rig, Bundle(stack, jnp.asarray(start)), observations, cameras, points)


def _find(folder: Path, name: str) -> Path:
    packed = folder / f"{name}.gz"
    return packed if packed.is_file() and not (folder / name).is_file() else folder / name


def _read_rig(path: Path) -> StereoRig:
    rows = _read_rows(path, 6)
    if len(rows) != 1:
        raise DataError(path, f"has {len(rows)} rows, needs one: fx fy skew cx cy baseline")
    fx, fy, skew, cx, cy, baseline = (float(value) for value in rows[0])
    if not (is_positive(fx) and is_positive(fy) and is_positive(baseline)):
        raise DataError(path, f"focal lengths {fx:g}, {fy:g} px and baseline {baseline:g} m must be positive")
    return StereoRig(Pinhole(fx, fy, cx, cy, skew), baseline)


def _read_cameras(path: Path) -> tuple[Int64[np.ndarray, " c"], Float64[np.ndarray, "c 4 4"]]:
    rows = _read_rows(path, 17)
    matrices = rows[:, 1:].reshape(-1, 4, 4)
    check_rotations(path, matrices)
    wrong = np.flatnonzero(np.abs(matrices[:, 3] - np.array([0.0, 0.0, 0.0, 1.0])).max(axis=1) > 1e-9)
    if wrong.size:
        raise DataError(path, f"row {wrong[0] + 1} is no pose: its last four numbers are not 0 0 0 1")
    numbers = whole_numbers(path, rows[:, 0], "camera")
    cameras, order = np.unique(numbers, return_index=True)
    if len(cameras) != len(numbers):
        raise DataError(path, "has two poses of one camera")
    return cameras, matrices[order]


def _read_rows(path: Path, count: int) -> Float64[np.ndarray, "n count"]:
    rows = read_rows(path, count)
    if not len(rows):
        raise DataError(path, "is empty")
    return rows
