"""Laser range finders in a map: the likelihood field of end points, and the beam model with rays traced to the wall."""

import math
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jax.scipy.stats import norm
from jaxtyping import Array, Bool, Float

from jaxloc.beliefs.conditional import Sensor
from jaxloc.poses import SE2
from jaxloc.sensors.maps import DistanceField

_SHORTEST = 1e-3  # ranges up to here are no readings, m


class LaserScan(eqx.Module):
    """One sweep of a planar range finder.

    Its tangent holds the ranges alone: the directions are part of the device, and static.

    Args:
        ranges: "b" (a stack of scans has leading axes), m; readings that are no finite number, or not positive, are
            masked wherever the scan is used.
        angle_min: direction of the first beam, counter-clockwise from the device's x axis, rad.
        angle_increment: from one beam to the next, rad.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> scan = jl.sensors.LaserScan(jnp.arange(1.0, 7.0), angle_min=-0.25, angle_increment=0.1)
        >>> scan.thin(3).ranges.tolist(), [round(x, 3) for x in scan.thin(3).angles.tolist()]
        ([2.0, 4.0, 6.0], [-0.15, 0.05, 0.25])
    """

    ranges: Float[Array, "*t b"]
    angle_min: float = eqx.field(static=True)
    angle_increment: float = eqx.field(static=True)

    @property
    def angles(self) -> Float[Array, " b"]:
        """Direction of every beam, rad."""
        number = jnp.arange(self.ranges.shape[-1], dtype=self.ranges.dtype)
        return self.angle_min + self.angle_increment * number

    def thin(self, num_beams: int) -> "LaserScan":
        """At most so many beams, evenly spaced over the sweep; the last axis of a stack of scans is thinned."""
        size = self.ranges.shape[-1]
        if num_beams < 1:
            raise ValueError(f"thin got num_beams={num_beams}; a scan has at least one beam.")
        step = -(-size // min(num_beams, size))
        first = step // 2
        start = self.angle_min + first * self.angle_increment
        return LaserScan(self.ranges[..., first::step], start, step * self.angle_increment)


def beam_mask(scan: LaserScan, valid: Bool[Array, "*m"], max_range: Float[Array, ""]) -> Bool[Array, " b"]:
    """Which beams hit something: valid, finite, positive and short of the greatest range.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> scan = jl.sensors.LaserScan(jnp.array([1.0, jnp.nan, -1.0, 9.0]), 0.0, 0.1)
        >>> jl.sensors.laser.beam_mask(scan, jnp.array(True), jnp.array(8.0)).tolist()
        [True, False, False, False]
    """
    ranges = scan.ranges
    return valid & jnp.isfinite(ranges) & (ranges > _SHORTEST) & (ranges < max_range)


class LikelihoodField(Sensor):
    """How near the end points of beams come to the obstacles of a map, whatever lies between.

    ``log p(z | x) = c sum_b log(z_hit N(d_b; 0, sigma^2) + z_rand / z_max)``, with d_b the distance from the end point
    of beam b to the nearest obstacle. Smooth in the pose, and one look-up a beam. Beams of one scan err together (the
    map, what moved, the pose of the mount), and taking them as independent makes the belief far too sure: ``c`` counts
    all beams as `independent_beams` at most.

    Args:
        field: of the map.
        mount: ``T_robot_laser``.
        sigma: spread of end points about the obstacles, m.
        z_hit: part of the beams that end at obstacles of the map; the rest is spread over all ranges.
        max_range: a beam that is at least so long hit nothing and counts nothing, m.
        independent_beams: how many beams the whole scan is worth.

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

    def expect(self, state: SE2, measurement: LaserScan) -> LaserScan:
        """Ranges to the walls of the map."""
        pose = state @ self.mount
        return _scan_like(measurement, trace(self.field, pose, measurement.angles, max_range=self.max_range))

    def covariance(self, state: SE2, measurement: LaserScan) -> Float[Array, "b b"]:
        """Independent ranges with the spread of end points."""
        return jnp.eye(measurement.ranges.shape[0], dtype=self.sigma.dtype) * self.sigma**2

    def distances(self, state: SE2, measurement: LaserScan, mask: Bool[Array, " b"]) -> Float[Array, " b"]:
        """From the end point of each beam to the nearest obstacle, m; masked beams end at the laser."""
        ranges, angles = jnp.where(mask, measurement.ranges, 0.0), measurement.angles
        x, y = self._in_robot(ranges * jnp.cos(angles), ranges * jnp.sin(angles))
        return self.field.lookup(*self.field.to_grid(state, x, y))

    def log_prob(self, state: SE2, measurement: LaserScan, valid: Bool[Array, "*m"]) -> Float[Array, ""]:
        """Log density of the scan at a pose; beams that are masked count nothing."""
        mask = beam_mask(measurement, valid, self.max_range)
        scaled = self.distances(state, measurement, mask) / self.sigma
        hit = self.z_hit / (math.sqrt(2.0 * math.pi) * self.sigma) * jnp.exp(-0.5 * scaled**2)
        logs = jnp.log(hit + (1.0 - self.z_hit) / self.max_range)
        return jnp.sum(jnp.where(mask, logs, 0.0)) * discount(mask, self.independent_beams)

    def _in_robot(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Points of the laser's frame in the robot's: the same for all particles, so that it is done once a scan."""
        rotation, shift = self.mount.rotation, self.mount.translation
        return rotation.cos * x - rotation.sin * y + shift[0], rotation.sin * x + rotation.cos * y + shift[1]


class BeamModel(Sensor):
    """What each beam should read: the wall, something in front of it, nothing, or anything.

    ``p(z | x) = z_hit N(z; z*, sigma^2) + z_short Exp(z; lambda | z < z*) + z_rand / z_max`` for ranges below
    ``z_max``; at it, the probability ``z_max_part + z_hit P(hit beyond z_max)``. The expected range ``z*`` is traced
    through the distance field and differentiable in pose and map. Parts sum to one.

    Args:
        field: of the map; its ceiling bounds the steps of the rays.
        mount: ``T_robot_laser``.
        sigma: of ranges to the walls, m.
        z_hit: part of the beams that read the map's walls.
        z_short: part that end at something in front of the wall.
        z_max_part: part that read nothing; the rest is spread over all ranges.
        short_rate: how fast unexpected obstacles become rarer with range, 1/m.
        max_range: what the device reads where there is nothing, m.
        independent_beams: how many beams the whole scan is worth (see `LikelihoodField`).
        num_steps: steps of a ray.

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

    def expect(self, state: SE2, measurement: LaserScan) -> LaserScan:
        """Ranges to the walls of the map; the greatest range where there is none."""
        pose = state @ self.mount
        ranges = trace(self.field, pose, measurement.angles, max_range=self.max_range, num_steps=self.num_steps)
        return _scan_like(measurement, ranges)

    def covariance(self, state: SE2, measurement: LaserScan) -> Float[Array, "b b"]:
        """Independent ranges."""
        return jnp.eye(measurement.ranges.shape[0], dtype=self.sigma.dtype) * self.sigma**2

    def log_prob(self, state: SE2, measurement: LaserScan, valid: Bool[Array, "*m"]) -> Float[Array, ""]:
        """Log density of the scan at a pose; readings of at least `max_range` count as such, bad ones nothing."""
        ranges = measurement.ranges
        mask = valid & jnp.isfinite(ranges) & (ranges > _SHORTEST)
        read = jnp.where(mask, jnp.minimum(ranges, self.max_range), 1.0)
        logs = jnp.log(self._density(read, self.expect(state, measurement).ranges))
        return jnp.sum(jnp.where(mask, logs, 0.0)) * discount(mask, self.independent_beams)

    def _density(self, read: Array, expected: Array) -> Array:
        hit = jnp.exp(-0.5 * ((read - expected) / self.sigma) ** 2) / (math.sqrt(2.0 * math.pi) * self.sigma)
        near = jnp.maximum(expected, _SHORTEST)
        within = self.short_rate / -jnp.expm1(-self.short_rate * near) * jnp.exp(-self.short_rate * read)
        rest = jnp.maximum(1.0 - self.z_hit - self.z_short - self.z_max_part, 1e-6)
        below = self.z_hit * hit + self.z_short * jnp.where(read < near, within, 0.0) + rest / self.max_range
        beyond = norm.cdf((expected - self.max_range) / self.sigma)
        return jnp.where(read < self.max_range, below, self.z_max_part + self.z_hit * beyond + 1e-6)


def discount(mask: Bool[Array, " b"], independent_beams: Float[Array, ""]) -> Float[Array, ""]:
    """What each beam counts where all together are worth `independent_beams` at most.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> float(jl.sensors.laser.discount(jnp.ones(60, bool), jnp.array(15.0)))
        0.25
    """
    count = jnp.maximum(jnp.sum(mask), 1).astype(independent_beams.dtype)
    return jnp.minimum(independent_beams / count, 1.0)


@eqx.filter_jit
def trace(
    field: DistanceField,
    pose: SE2,
    angles: Float[Array, " b"],
    *,
    max_range: float | Float[Array, ""],
    num_steps: int = 40,
) -> Float[Array, " b"]:
    """Ranges from a pose to the obstacles of a map, by steps as long as the nearest obstacle is far.

    A ray ends half a cell short of the center of an obstacle's cell, at its face. After the steps, which carry no
    derivative, comes one Newton step on ``d(range) = face``, which has the exact derivative of the solution.

    Args:
        field: of the map; the greater its ceiling, the fewer steps are needed.
        pose: ``T_world_laser``.
        angles: of the rays in the laser's frame, rad.
        max_range: where rays end that hit nothing, m.
        num_steps: fixed; a ray that needs more falls short.

    Returns:
        Ranges "b", m.

    References:
        Hart, "Sphere tracing", The Visual Computer 1996.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> wall = jnp.zeros((40, 60)).at[:, 50].set(1.0)
        >>> field = jl.sensors.DistanceField.of(jl.sensors.OccupancyMap(wall, 0.1, jl.poses.SE2.identity()))
        >>> pose, angles = jl.poses.SE2(2.0, 2.0, 0.0), jnp.array([0.0, jnp.pi])
        >>> [round(x, 3) for x in jl.sensors.laser.trace(field, pose, angles, max_range=8.0).tolist()]
        [3.0, 8.0]
    """
    cos, sin = jnp.cos(angles), jnp.sin(angles)
    face = 0.5 * field.resolution

    def gap(place: SE2, values: DistanceField, length: Array) -> Array:
        return values.lookup(*values.to_grid(place, length * cos, length * sin)) - face

    fixed, still = lax.stop_gradient(pose), lax.stop_gradient(field)
    limit = lax.stop_gradient(jnp.asarray(max_range, field.resolution.dtype))

    def advance(_, length):
        return jnp.minimum(length + jnp.maximum(gap(fixed, still, length), 0.0), limit)

    length = lax.stop_gradient(lax.fori_loop(0, num_steps, advance, jnp.zeros_like(angles)))
    # How fast the gap closes along the ray, by a difference over a cell: the field has corners that a derivative would
    # see.
    slope = (gap(fixed, still, length) - gap(fixed, still, jnp.maximum(length - face, 0.0))) / face
    refined = length - gap(pose, field, length) / jnp.minimum(slope, -0.1)
    hit = (length < limit) & (gap(fixed, still, length) < face)
    return jnp.where(hit, jnp.clip(refined, 0.0, limit), length)


def _scan_like(scan: LaserScan, ranges: Array) -> LaserScan:
    return LaserScan(ranges, scan.angle_min, scan.angle_increment)
