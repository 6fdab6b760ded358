"""Odometry increments as controls of a filter, with noise that grows with distance, turn and time."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxloc._arguments import checked
from jaxloc.beliefs import Motion
from jaxloc.poses import SE2
from jaxloc.poses.lie_group import as_floats
from jaxloc.sensors.landmarks import length


class Increment(eqx.Module):
    """An odometry increment.

    Attributes:
        dt: duration, s.
        motion: T_before_after.
    """

    dt: Float[Array, ""]
    motion: SE2


class IncrementMotion(Motion):
    """Dead reckoning with variances proportional to distance, turn and time, so that they add up over partial steps.

    The noise is normal in the frame after the step::

        along, across:  sigma^2 = drive^2 |s| + idle^2 dt,    side^2 |s| + idle^2 dt
        heading:       sigma^2 = turn_drive^2 |s| + turn_turn^2 |r| + turn_idle^2 dt

    Args:
        drive: standard deviation along the motion, m, after 1 m.
        side: standard deviation across the motion, m, after 1 m.
        idle: standard deviation of the position, m, after 1 s.
        turn_drive: standard deviation of the heading, rad, after 1 m.
        turn_turn: standard deviation of the heading, rad, after a turn of 1 rad.
        turn_idle: standard deviation of the heading, rad, after 1 s.

    References:
        Kelly, "Linearized error propagation in odometry", IJRR 2004.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> motion = jl.sensors.IncrementMotion(drive=0.1, idle=0.0)
        >>> control = jl.sensors.Increment(jnp.array(1.0), jl.poses.SE2(4.0, 0.0, 0.0))
        >>> round(float(motion.covariance(jl.poses.SE2(0.0, 0.0, 0.0), control)[0, 0]), 3)
        0.04
    """

    drive: Float[Array, ""]
    side: Float[Array, ""]
    idle: Float[Array, ""]
    turn_drive: Float[Array, ""]
    turn_turn: Float[Array, ""]
    turn_idle: Float[Array, ""]

    def __init__(
        self,
        *,
        drive: Any = 0.05,
        side: Any = 0.02,
        idle: Any = 0.001,
        turn_drive: Any = 0.02,
        turn_turn: Any = 0.05,
        turn_idle: Any = 0.001,
    ):
        self.drive, self.side, self.idle = as_floats(drive, side, idle)
        self.turn_drive, self.turn_turn, self.turn_idle = as_floats(turn_drive, turn_turn, turn_idle)

    @checked
    def move(self, state: SE2, control: Increment) -> SE2:
        """The pose moved by the increment."""
        return state @ control.motion

    @checked
    def covariance(self, state: SE2, control: Increment) -> Float[Array, "3 3"]:
        """Covariance of (along, across, heading) in the frame after the step."""
        del state
        distance, turn = length(control.motion.translation), jnp.abs(control.motion.theta)
        along = self.drive**2 * distance + self.idle**2 * control.dt
        across = self.side**2 * distance + self.idle**2 * control.dt
        heading = self.turn_drive**2 * distance + self.turn_turn**2 * turn + self.turn_idle**2 * control.dt
        return jnp.diag(jnp.stack([along, across, heading]))

    def linearize(self, state: SE2, control: Increment) -> tuple[SE2, Float[Array, "3 3"]]:
        """The moved pose and the adjoint of the inverse motion."""
        return self.move(state, control), control.motion.inverse().adjoint()
