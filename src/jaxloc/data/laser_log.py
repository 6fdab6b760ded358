"""Planar laser log: time-stamped scans with odometry, as host arrays."""

import equinox as eqx
import numpy as np
from jaxtyping import Float32, Float64

from jaxloc.poses import SE2
from jaxloc.sensors import LaserScan


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

    def __len__(self) -> int:
        return len(self.times)

    def scans(self, indices: slice | np.ndarray | int = slice(None)) -> LaserScan:
        """Scans as the library's record, stacked along the leading axis."""
        import jax.numpy as jnp

        return LaserScan(jnp.asarray(self.ranges[indices]), self.angle_min, self.angle_increment)

    def mount_pose(self) -> SE2:
        """``T_robot_laser``."""
        return SE2(*self.mount)
