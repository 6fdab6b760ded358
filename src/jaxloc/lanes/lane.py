"""Lane geometry relative to the vehicle: a clothoid center line on the ground ahead."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxloc.poses.lie_group import as_floats


class Lane(eqx.Module):
    """Clothoid lane in the road frame of a vehicle (x forward, y left).

    The center runs through ``y(x) = -offset - tan(heading) x + curvature x^2 / 2 + rate x^3 / 6``: the Taylor series of
    a clothoid whose direction changes little within view, as on every road one may drive fast on.

    Args:
        offset: how far the vehicle is left of the lane's center, m.
        heading: direction of the vehicle against that of the lane, counter-clockwise, rad.
        curvature: of the lane beside the vehicle, 1/m; positive bends left.
        rate: change of the curvature by arc length, 1/m^2.

    References:
        E. D. Dickmanns and B. D. Mysliwetz, "Recursive 3-D road and relative ego-state recognition", PAMI 1992, section
        III [K-28], [K-31].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> lane = jl.lanes.Lane(offset=0.5, heading=0.0, curvature=0.001)
        >>> lane.center(jnp.array([0.0, 100.0])).tolist()
        [-0.5, 4.5]
    """

    offset: Float[Array, ""]
    heading: Float[Array, ""]
    curvature: Float[Array, ""]
    rate: Float[Array, ""]

    def __init__(self, offset: Any, heading: Any, curvature: Any, rate: Any = 0.0):
        self.offset, self.heading, self.curvature, self.rate = as_floats(offset, heading, curvature, rate)

    def center(self, x: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Where the center of the lane is ``x`` ahead: m to the left of the vehicle's axis."""
        bend = 0.5 * self.curvature + x * (self.rate / 6.0)
        return -self.offset + x * (x * bend - jnp.tan(self.heading))

    def direction(self, x: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Direction of the lane against the vehicle's axis ``x`` ahead, rad, counter-clockwise."""
        return jnp.arctan(x * (self.curvature + 0.5 * x * self.rate) - jnp.tan(self.heading))

    def lateral(self, x: Float[Array, "*n"], y: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Lateral distance of ground points to the left of the lane's center, along the vehicle's y axis, m."""
        return y - self.center(x)

    def advance(self, distance: Float[Array, ""], turn: Float[Array, ""]) -> "Lane":
        """The same lane in the vehicle frame after a motion of the vehicle.

        Args:
            distance: along its path, m.
            turn: change of its direction on the way, counter-clockwise, rad.

        Returns:
            The lane from there; the vehicle is taken to turn at a constant rate.
        """
        there = self.curvature + distance * self.rate
        bend = distance * (self.curvature + 0.5 * distance * self.rate)
        drift = distance * (self.curvature + distance * self.rate / 3.0) * 0.5
        offset = self.offset + distance * (jnp.tan(self.heading) + 0.5 * turn - drift)
        return Lane(offset, self.heading + turn - bend, there, self.rate)
