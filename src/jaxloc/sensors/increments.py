"""How a robot moved between two moments, by its odometry: the control of a filter that wakes up with each reading."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxloc.beliefs import Motion
from jaxloc.poses import SE2
from jaxloc.poses.lie_group import as_floats
from jaxloc.sensors.landmarks import length


class Increment(eqx.Module):
    """A motion, and how long it took.

    Attributes:
        dt: s.
        motion: T_before_after.
    """

    dt: Float[Array, ""]
    motion: SE2


class IncrementMotion(Motion):
    """Dead reckoning whose variances grow with way, turn and time, so that two half steps err as a whole one does.

    The noise is a normal in the frame after the step::

        along, aside:  sigma^2 = drive^2 |s| + idle^2 dt,    side^2 |s| + idle^2 dt
        heading:       sigma^2 = turn_drive^2 |s| + turn_turn^2 |r| + turn_idle^2 dt

    Args:
        drive: m at 1 m of way, along it.
        side: m at 1 m of way, across it.
        idle: m at 1 s.
        turn_drive: rad at 1 m of way.
        turn_turn: rad at a turn of 1 rad.
        turn_idle: rad at 1 s.

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

    def move(self, state: SE2, control: Increment) -> SE2:
        """The pose moved by what odometry says."""
        return state @ control.motion

    def covariance(self, state: SE2, control: Increment) -> Float[Array, "3 3"]:
        """Of (along, aside, heading) in the frame after the step."""
        del state
        way, turn = length(control.motion.translation), jnp.abs(control.motion.theta)
        along = self.drive**2 * way + self.idle**2 * control.dt
        aside = self.side**2 * way + self.idle**2 * control.dt
        heading = self.turn_drive**2 * way + self.turn_turn**2 * turn + self.turn_idle**2 * control.dt
        return jnp.diag(jnp.stack([along, aside, heading]))

    def linearize(self, state: SE2, control: Increment) -> tuple[SE2, Float[Array, "3 3"]]:
        """The moved pose and the adjoint of the way back."""
        return self.move(state, control), control.motion.inverse().adjoint()
