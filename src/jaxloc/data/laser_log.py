"""Planar laser log: time-stamped scans with odometry, as host arrays."""

from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float32, Float64

from jaxloc.poses import SE2
from jaxloc.poses.planar import relative_poses
from jaxloc.sensors import LaserScan

_RIGID = 0.05  # m or rad that the laser may seem to move on the robot, by rounding
_MOVED = 0.5  # m or rad of odometry, after which a laser that stayed in place was never set


class LaserLog(eqx.Module):
    """A recording of one planar laser on a robot with odometry.

    Args:
        name: a short name for titles.
        times: of the scans, s in the clock of the log, increasing.
        ranges: "n b", m; may hold anything, also no numbers: users mask them.
        odometry: "n 3" robot pose (x, y, heading) by odometry at each scan, in a frame of its own, m and rad.
        angle_min: direction of the first beam in the frame of the laser, rad.
        angle_increment: rad.
        max_range: what the device reads where nothing is, m.
        mount: (x, y, heading) of the laser on the robot.
        corrected: "n 3" robot poses that someone else found, where the log holds them.
        dropped: scans that were left out because time went backwards.
        mounting: how the mount was found, for reports.
    """

    name: str
    times: Float64[np.ndarray, " n"]
    ranges: Float32[np.ndarray, "n b"]
    odometry: Float64[np.ndarray, "n 3"]
    angle_min: float
    angle_increment: float
    max_range: float
    mount: tuple[float, float, float] = (0.0, 0.0, 0.0)
    corrected: Float64[np.ndarray, "n 3"] | None = None
    dropped: int = 0
    mounting: str = eqx.field(static=True, default="")

    def __len__(self) -> int:
        return len(self.times)

    def scans(self, indices: slice | np.ndarray | int = slice(None)) -> LaserScan:
        """Scans as the library's record, stacked along the leading axis."""
        import jax.numpy as jnp

        return LaserScan(jnp.asarray(self.ranges[indices]), self.angle_min, self.angle_increment)

    def mount_pose(self) -> SE2:
        """``T_robot_laser``."""
        return SE2(*self.mount)


class Mounting(NamedTuple):
    """What the poses of a laser say about its place on the robot.

    Attributes:
        kind: of `RIGID`, `CORRECTED` and `UNSET`.
        pose: (x, y, heading) of the laser on the robot; zero unless it is rigid.
    """

    kind: str
    pose: tuple[float, float, float] = (0.0, 0.0, 0.0)

    RIGID = "rigid"
    CORRECTED = "corrected"
    UNSET = "unset"

    def describe(self) -> str:
        """A sentence for reports."""
        x, y, heading = self.pose
        if self.kind == self.RIGID:
            return f"The laser is mounted at ({x:.3g}, {y:.3g}) m, {np.degrees(heading):.3g} degrees."
        if self.kind == self.UNSET:
            return "The log never sets the pose of the laser: it is taken to be that of the robot."
        return "The laser moves against the odometry: its poses are taken for corrected poses of the robot."


def find_mounting(odometry: Float64[np.ndarray, "n 3"], lasers: Float64[np.ndarray, "n 3"]) -> Mounting:
    """Decides from all scans whether the laser stands still on the robot, was corrected, or has no pose.

    Headings are compared as directions: a laser that looks backwards has relative headings of about -pi and pi.

    Args:
        odometry: poses (x, y, heading) of the robot, m and rad.
        lasers: poses of the laser.

    Returns:
        The mounting.

    Example:
        >>> drive = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
        >>> find_mounting(drive, drive + np.array([-0.2, 0.0, 1.5])).describe()
        'The laser is mounted at (-0.2, 0) m, 85.9 degrees.'
        >>> find_mounting(drive, 0.0 * drive).kind
        'unset'
    """
    given = ~_unset(odometry, lasers)
    if not given.any():
        return Mounting(Mounting.UNSET)
    relative = relative_poses(odometry[given], lasers[given])
    angles = relative[:, 2]
    mean = np.arctan2(np.sin(angles).mean(), np.cos(angles).mean())
    # Wrapped about their mean direction, angles can be compared as numbers.
    relative[:, 2] = mean + np.arctan2(np.sin(angles - mean), np.cos(angles - mean))
    mount = np.median(relative, axis=0)
    if np.percentile(np.abs(relative - mount), 99) >= _RIGID:
        return Mounting(Mounting.CORRECTED)
    x, y, heading = (float(value) for value in mount)
    return Mounting(Mounting.RIGID, (x, y, heading))


def _unset(odometry: Float64[np.ndarray, "n 3"], lasers: Float64[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Scans without a pose of the laser: zero where the robot is elsewhere, or all the same while it drives."""
    if np.ptp(lasers, axis=0).max() < 1e-9 and np.ptp(odometry, axis=0).max() > _MOVED:
        return np.ones(len(lasers), bool)
    return (lasers == 0.0).all(axis=1) & (np.abs(odometry) > 1e-9).any(axis=1)
