"""Scans of planar laser range finders."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxloc._arguments import checked

SHORTEST = 1e-3  # least valid range, m


class LaserScan(eqx.Module):
    """One scan of a planar laser range finder.

    Its tangent holds the ranges only: the directions of the beams are static.

    Args:
        ranges: "b" (a stack of scans has leading axes), m; non-finite and nonpositive readings are masked wherever the
            scan is used.
        angle_min: direction of the first beam, counter-clockwise from the device's x axis, rad.
        angle_increment: between successive beams, rad.

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
        """A scan with at most a number of beams, evenly spaced; the last axis of a stack of scans is thinned."""
        size = self.ranges.shape[-1]
        if num_beams < 1:
            raise ValueError(f"thin got num_beams={num_beams}; a scan has at least one beam.")
        step = -(-size // min(num_beams, size))
        first = step // 2
        angle_min = self.angle_min + first * self.angle_increment
        return LaserScan(self.ranges[..., first::step], angle_min, step * self.angle_increment)


@checked
def beam_mask(scan: LaserScan, valid: Bool[Array, "*m"], max_range: Float[Array, ""]) -> Bool[Array, " b"]:
    """Mask of the beams with a return: valid, finite, positive and below the largest range.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> scan = jl.sensors.LaserScan(jnp.array([1.0, jnp.nan, -1.0, 9.0]), 0.0, 0.1)
        >>> jl.sensors.laser_scan.beam_mask(scan, jnp.array(True), jnp.array(8.0)).tolist()
        [True, False, False, False]
    """
    ranges = scan.ranges
    return valid & jnp.isfinite(ranges) & (ranges > SHORTEST) & (ranges < max_range)


@checked
def discount(mask: Bool[Array, " b"], independent_beams: Float[Array, ""]) -> Float[Array, ""]:
    """Weight of each beam, so that all together count as at most `independent_beams`.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> float(jl.sensors.laser_scan.discount(jnp.ones(60, bool), jnp.array(15.0)))
        0.25
    """
    count = jnp.maximum(jnp.sum(mask), 1).astype(independent_beams.dtype)
    return jnp.minimum(independent_beams / count, 1.0)


def scan_like(scan: LaserScan, ranges: Array) -> LaserScan:
    """A scan with new ranges in the directions of the given one."""
    return LaserScan(ranges, scan.angle_min, scan.angle_increment)
