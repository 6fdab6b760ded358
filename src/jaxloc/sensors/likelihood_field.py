"""Likelihood field of a laser range finder: distances from the end points of beams to the nearest obstacle."""

import math
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxloc._arguments import checked
from jaxloc.beliefs.models import Sensor
from jaxloc.poses import SE2
from jaxloc.sensors.laser_scan import LaserScan, beam_mask, discount, scan_like
from jaxloc.sensors.maps.distance_field import DistanceField, trace


class LikelihoodField(Sensor):
    """Likelihood field model of a laser scan: distances of beam end points to the obstacles of a map.

    ``log p(z | x) = c sum_b log(z_hit N(d_b; 0, sigma^2) + z_rand / z_max)``, with d_b the distance from the end point
    of beam b to the nearest obstacle. Smooth in the pose, at one look-up per beam. Errors of the beams of one scan are
    correlated (map, moving objects, mount), and treating them as independent makes the density overconfident: ``c``
    counts all beams as at most `independent_beams`.

    Args:
        field: of the map.
        mount: ``T_robot_laser``.
        sigma: standard deviation of end points about the obstacles, m.
        z_hit: weight of hits of the map's obstacles; the rest is uniform over all ranges.
        max_range: longer beams have no return and are ignored, m.
        independent_beams: effective number of independent beams in a scan.

    References:
        Thrun, Burgard, Fox, *Probabilistic Robotics*, 2005, table 6.3.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> wall = jnp.zeros((40, 60)).at[:, 50].set(1.0)
        >>> field = jl.sensors.DistanceField.of(jl.sensors.OccupancyMap(wall, 0.1, jl.poses.SE2.identity()))
        >>> sensor = jl.sensors.LikelihoodField(field)
        >>> scan = jl.sensors.LaserScan(jnp.array([3.05, jnp.nan]), 0.0, 0.1)
        >>> near, far = (sensor.log_prob(jl.poses.SE2(x, 2.0, 0.0), scan, jnp.array(True)) for x in (2.0, 1.5))
        >>> bool(near > far + 2)
        True
    """

    field: DistanceField
    mount: SE2
    sigma: Float[Array, ""]
    z_hit: Float[Array, ""]
    max_range: Float[Array, ""]
    independent_beams: Float[Array, ""]

    def __init__(
        self,
        field: DistanceField,
        mount: SE2 | None = None,
        *,
        sigma: Any = 0.1,
        z_hit: Any = 0.9,
        max_range: Any = 30.0,
        independent_beams: Any = 1e6,
    ):
        dtype = field.distance.dtype
        self.field = field
        self.mount = SE2.identity(dtype) if mount is None else mount
        self.sigma, self.z_hit, self.max_range, self.independent_beams = (
            jnp.asarray(value, dtype) for value in (sigma, z_hit, max_range, independent_beams)
        )

    @checked
    def expect(self, state: SE2, measurement: LaserScan) -> LaserScan:
        """Ranges to the obstacles of the map."""
        pose = state @ self.mount
        return scan_like(measurement, trace(self.field, pose, measurement.angles, max_range=self.max_range))

    @checked
    def covariance(self, state: SE2, measurement: LaserScan) -> Float[Array, "b b"]:
        """Independent ranges with the standard deviation of end points."""
        return jnp.eye(measurement.ranges.shape[0], dtype=self.sigma.dtype) * self.sigma**2

    @checked
    def distances(self, state: SE2, measurement: LaserScan, mask: Bool[Array, " b"]) -> Float[Array, " b"]:
        """Distance from the end point of each beam to the nearest obstacle, m; masked beams end at the laser."""
        ranges, angles = jnp.where(mask, measurement.ranges, 0.0), measurement.angles
        x, y = self._in_robot(ranges * jnp.cos(angles), ranges * jnp.sin(angles))
        return self.field.lookup(*self.field.to_grid(state, x, y))

    @checked
    def log_prob(self, state: SE2, measurement: LaserScan, valid: Bool[Array, "*m"]) -> Float[Array, ""]:
        """Log density of the scan at a pose; masked beams are ignored."""
        mask = beam_mask(measurement, valid, self.max_range)
        scaled = self.distances(state, measurement, mask) / self.sigma
        hit = self.z_hit / (math.sqrt(2.0 * math.pi) * self.sigma) * jnp.exp(-0.5 * scaled**2)
        logs = jnp.log(hit + (1.0 - self.z_hit) / self.max_range)
        return jnp.sum(jnp.where(mask, logs, 0.0)) * discount(mask, self.independent_beams)

    def _in_robot(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Points of the laser's frame in the robot's: the same for all particles, so that it is done once a scan."""
        rotation, shift = self.mount.rotation, self.mount.translation
        return rotation.cos * x - rotation.sin * y + shift[0], rotation.sin * x + rotation.cos * y + shift[1]
