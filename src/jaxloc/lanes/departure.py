"""Lane departure warning: the time until a wheel crosses a lane border."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxloc._jit import filter_jit
from jaxloc.lanes.lane import Lane
from jaxloc.poses.lie_group import as_floats


class LineCrossing(eqx.Module):
    """Time to line crossing of a vehicle that does not steer.

    Attributes:
        time: s; infinite if it does not, zero if it is on a line already.
        side: 1 for the left line, -1 for the right one, 0 if there is no crossing.
        inside: whether both sides of the vehicle are within the lane now.
    """

    time: Float[Array, ""]
    side: Float[Array, ""]
    inside: Bool[Array, ""]


@filter_jit
def time_to_line_crossing(
    lane: Lane, lane_width: Any = 3.6, vehicle_width: Any = 1.8, speed: Any = 20.0, *, horizon: Any = 200.0
) -> LineCrossing:
    """Time until one side of a vehicle that does not steer reaches a border of its lane [K-30].

    Against the lane, a vehicle that goes straight moves by ``n(x) = offset + tan(heading) x - curvature x^2 / 2``; the
    first positive root of ``n(x) = +-(lane - vehicle) / 2`` over its speed is the time. The change of curvature is left
    out: it matters for long horizons, not for warnings.

    Args:
        lane: where the vehicle is.
        lane_width: m.
        vehicle_width: m.
        speed: m/s; at rest no border is crossed.
        horizon: crossings farther ahead are none, m.

    Returns:
        The first crossing. A vehicle that is over a line already has time zero.

    References:
        W. van Winsum, K. Brookhuis and D. de Waard, "A comparison of different ways to approximate time-to-line
        crossing", Accident Analysis and Prevention 2000 [K-30].

    Example:
        >>> import jaxloc as jl
        >>> lane = jl.lanes.Lane(offset=0.5, heading=0.02, curvature=0.0)
        >>> crossing = jl.lanes.departure.time_to_line_crossing(lane, 3.6, 1.8, 20.0)
        >>> round(float(crossing.time), 3), float(crossing.side)
        (1.0, 1.0)
    """
    lane_width, vehicle_width, speed, horizon = as_floats(lane_width, vehicle_width, speed, horizon)
    room = 0.5 * (lane_width - vehicle_width)
    slope, bend = jnp.tan(lane.heading), -0.5 * lane.curvature
    ways = jnp.stack([_first_root(bend, slope, lane.offset - side * room) for side in (1.0, -1.0)])
    inside = jnp.abs(lane.offset) < room
    moving = speed > 1e-3
    best = jnp.argmin(ways)
    crosses = moving & (ways[best] < horizon)
    time = jnp.where(crosses, ways[best] / jnp.where(moving, speed, 1.0), jnp.inf)
    side = jnp.where(crosses, jnp.where(best == 0, 1.0, -1.0), 0.0).astype(time.dtype)
    over = jnp.sign(lane.offset)
    return LineCrossing(jnp.where(inside, time, 0.0), jnp.where(inside, side, over), inside)


def _first_root(a: Float[Array, ""], b: Float[Array, ""], c: Float[Array, ""]) -> Float[Array, ""]:
    """The least positive root of ``a x^2 + b x + c``, or infinity; finite derivatives wherever there is one."""
    discriminant = b * b - 4.0 * a * c
    real = discriminant > 0.0
    root = jnp.sqrt(jnp.where(real, discriminant, 1.0))
    # Citardauq's form loses no digits where the bend is small: x = 2c / (-b -+ root).
    below = jnp.stack([-b - root, -b + root])
    usable = real & (jnp.abs(below) > 1e-12)
    candidates = 2.0 * c / jnp.where(usable, below, 1.0)
    return jnp.min(jnp.where(usable & (candidates > 0.0), candidates, jnp.inf))
