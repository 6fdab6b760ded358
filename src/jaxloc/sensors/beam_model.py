"""Beam model of a laser range finder: ray casting in a map, with short, missed and random readings."""

import math
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax.scipy.stats import norm
from jaxtyping import Array, Bool, Float

from jaxloc._arguments import checked
from jaxloc.beliefs.models import Sensor
from jaxloc.poses import SE2
from jaxloc.sensors.laser_scan import SHORTEST, LaserScan, discount, scan_like
from jaxloc.sensors.maps.distance_field import DistanceField, trace


class BeamModel(Sensor):
    """Beam model of a laser scan: a mixture of hits, unexpected obstacles, missing returns and random readings.

    ``p(z | x) = z_hit N(z; z*, sigma^2) + z_short Exp(z; lambda | z < z*) + z_rand / z_max`` for ranges below
    ``z_max``; at it, the probability ``z_max_part + z_hit P(hit beyond z_max)``. The expected range ``z*`` is traced
    through the distance field and differentiable in pose and map. The weights of the mixture sum to one.

    Args:
        field: distance field of the map; its largest distance bounds the steps of rays.
        mount: ``T_robot_laser``.
        sigma: standard deviation of ranges to obstacles of the map, m.
        z_hit: weight of hits of the map's obstacles.
        z_short: weight of unexpected obstacles in front of them.
        z_max_part: weight of missing returns; the rest is uniform over all ranges.
        short_rate: decay rate of unexpected obstacles with range, 1/m.
        max_range: reading of the device without a return, m.
        independent_beams: effective number of independent beams in a scan (see `LikelihoodField`).
        num_steps: number of steps along a ray.

    References:
        Thrun, Burgard, Fox, *Probabilistic Robotics*, 2005, table 6.1; Hart, "Sphere tracing", The Visual Computer
        1996.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> wall = jnp.zeros((40, 60)).at[:, 50].set(1.0)
        >>> field = jl.sensors.DistanceField.of(jl.sensors.OccupancyMap(wall, 0.1, jl.poses.SE2.identity()))
        >>> sensor = jl.sensors.BeamModel(field)
        >>> scan = jl.sensors.LaserScan(jnp.zeros(1), 0.0, 0.1)
        >>> [round(x, 3) for x in sensor.expect(jl.poses.SE2(2.0, 2.0, 0.0), scan).ranges.tolist()]
        [3.0]
    """

    field: DistanceField
    mount: SE2
    sigma: Float[Array, ""]
    z_hit: Float[Array, ""]
    z_short: Float[Array, ""]
    z_max_part: Float[Array, ""]
    short_rate: Float[Array, ""]
    max_range: Float[Array, ""]
    independent_beams: Float[Array, ""]
    num_steps: int = eqx.field(static=True)

    def __init__(
        self,
        field: DistanceField,
        mount: SE2 | None = None,
        *,
        sigma: Any = 0.1,
        z_hit: Any = 0.75,
        z_short: Any = 0.1,
        z_max_part: Any = 0.05,
        short_rate: Any = 0.5,
        max_range: Any = 30.0,
        independent_beams: Any = 1e6,
        num_steps: int = 40,
    ):
        dtype = field.distance.dtype
        self.field = field
        self.mount = SE2.identity(dtype) if mount is None else mount
        values = (sigma, z_hit, z_short, z_max_part, short_rate, max_range, independent_beams)
        arrays = [jnp.asarray(value, dtype) for value in values]
        self.sigma, self.z_hit, self.z_short, self.z_max_part, self.short_rate, self.max_range = arrays[:-1]
        self.independent_beams = arrays[-1]
        self.num_steps = num_steps

    @checked
    def expect(self, state: SE2, measurement: LaserScan) -> LaserScan:
        """Ranges to the obstacles of the map; the largest range where there is none."""
        pose = state @ self.mount
        ranges = trace(self.field, pose, measurement.angles, max_range=self.max_range, num_steps=self.num_steps)
        return scan_like(measurement, ranges)

    @checked
    def covariance(self, state: SE2, measurement: LaserScan) -> Float[Array, "b b"]:
        """Independent ranges."""
        return jnp.eye(measurement.ranges.shape[0], dtype=self.sigma.dtype) * self.sigma**2

    @checked
    def log_prob(self, state: SE2, measurement: LaserScan, valid: Bool[Array, "*m"]) -> Float[Array, ""]:
        """Log density of the scan at a pose; readings beyond `max_range` are clipped, non-finite ones ignored."""
        ranges = measurement.ranges
        mask = valid & jnp.isfinite(ranges) & (ranges > SHORTEST)
        read = jnp.where(mask, jnp.minimum(ranges, self.max_range), 1.0)
        logs = jnp.log(self._density(read, self.expect(state, measurement).ranges))
        return jnp.sum(jnp.where(mask, logs, 0.0)) * discount(mask, self.independent_beams)

    def _density(self, read: Array, expected: Array) -> Array:
        hit = jnp.exp(-0.5 * ((read - expected) / self.sigma) ** 2) / (math.sqrt(2.0 * math.pi) * self.sigma)
        near = jnp.maximum(expected, SHORTEST)
        within = self.short_rate / -jnp.expm1(-self.short_rate * near) * jnp.exp(-self.short_rate * read)
        rest = jnp.maximum(1.0 - self.z_hit - self.z_short - self.z_max_part, 1e-6)
        below = self.z_hit * hit + self.z_short * jnp.where(read < near, within, 0.0) + rest / self.max_range
        beyond = norm.cdf((expected - self.max_range) / self.sigma)
        return jnp.where(read < self.max_range, below, self.z_max_part + self.z_hit * beyond + 1e-6)
