"""Wheel odometry as motion models: turn-drive-turn with noise that grows with each, and slipping wheels."""

import math
from typing import Any

import jax.numpy as jnp
from jax.scipy.special import erf
from jaxtyping import Array, Bool, Float

from jaxloc._linalg import matmul
from jaxloc.beliefs.models import Motion, log_normal
from jaxloc.poses import SE2, local

_NO_WAY = 0.01  # below this distance the direction driven says nothing about a turn, m


class OdometryMotion(Motion):
    """Motion of a robot whose odometry counts turns of wheels: turn, drive, turn again, each with its own noise.

    The control is the relative pose ``u = T_before_after`` that odometry reports, split into a turn r1, a distance s
    and a turn r2. Their standard deviations are::

        sigma_r1^2 = turn_turn^2 r1^2 + turn_drive^2 s^2 + turn_floor^2        (r2 alike)
        sigma_s^2  = drive_drive^2 s^2 + drive_turn^2 (r1^2 + r2^2) + drive_floor^2

    Turns are measured towards the nearer end, so that driving backwards is no turn by pi. With probability `slip` the
    distance is off by a normal of `slip_scale` times itself: wheels spin, someone pushes, an encoder counts backwards
    as forwards. Without such tails one bad step loses the robot.

    Args:
        turn_turn: rad of noise for a rad of turn (Thrun's alpha_1).
        turn_drive: rad for a meter (alpha_2).
        drive_drive: m for a meter (alpha_3).
        drive_turn: m for a rad (alpha_4).
        turn_floor: noise of each turn at rest, rad.
        drive_floor: noise of the distance at rest, m.
        slip: probability that the distance is not to be trusted.
        slip_scale: its standard deviation then, as a part of the distance.

    References:
        Thrun, Burgard, Fox, *Probabilistic Robotics*, 2005, table 5.6 (there noise grows with its square root, as
        here).

    Example:
        >>> import jax, jax.numpy as jnp, jaxloc as jl
        >>> motion = jl.sensors.OdometryMotion(turn_turn=0.1, drive_drive=0.1)
        >>> start, driven = jl.poses.SE2(0.0, 0.0, jnp.pi / 2), jl.poses.SE2(1.0, 0.0, 0.0)
        >>> motion.move(start, driven).translation.round(3).tolist()
        [-0.0, 1.0]
        >>> motion.sample(start, driven, key=jax.random.key(0)).translation.shape
        (2,)
    """

    turn_turn: Float[Array, ""]
    turn_drive: Float[Array, ""]
    drive_drive: Float[Array, ""]
    drive_turn: Float[Array, ""]
    turn_floor: Float[Array, ""]
    drive_floor: Float[Array, ""]
    slip: Float[Array, ""]
    slip_scale: Float[Array, ""]

    def __init__(
        self,
        *,
        turn_turn: Any = 0.1,
        turn_drive: Any = 0.1,
        drive_drive: Any = 0.1,
        drive_turn: Any = 0.05,
        turn_floor: Any = 0.01,
        drive_floor: Any = 0.01,
        slip: Any = 0.0,
        slip_scale: Any = 1.5,
        dtype: Any = float,
    ):
        values = (turn_turn, turn_drive, drive_drive, drive_turn, turn_floor, drive_floor, slip, slip_scale)
        arrays = [jnp.asarray(value, dtype) for value in values]
        self.turn_turn, self.turn_drive, self.drive_drive, self.drive_turn = arrays[:4]
        self.turn_floor, self.drive_floor, self.slip, self.slip_scale = arrays[4:]

    def move(self, state: SE2, control: SE2) -> SE2:
        """The pose moved by what odometry reports."""
        return state @ control

    def noise_dimension(self, state: SE2) -> int:
        """Two turns, a distance, and one number that says whether the wheels slipped."""
        return 4

    def perturb(self, state: SE2, control: SE2, normal: Float[Array, "4"]) -> SE2:
        """The pose that standard normal numbers lead to."""
        first, drive, second = split_motion(control)
        sigma_first, sigma_drive, sigma_second = self._sigmas(first, drive, second)
        slips = falls_below(normal[3], self.slip)
        sigma_drive = jnp.where(slips, self._slipping(drive, sigma_drive), sigma_drive)
        turned = first + sigma_first * normal[0]
        length = drive + sigma_drive * normal[1]
        # The change goes on top of the reported motion, so that a step without noise is exact, also at rest.
        x = control.translation[0] + length * jnp.cos(turned) - drive * jnp.cos(first)
        y = control.translation[1] + length * jnp.sin(turned) - drive * jnp.sin(first)
        turn = SE2(0.0 * x, 0.0 * x, sigma_first * normal[0] + sigma_second * normal[2])
        return state @ SE2.from_parts(control.rotation.compose(turn.rotation), jnp.stack([x, y]))

    def covariance(self, state: SE2, control: SE2) -> Float[Array, "3 3"]:
        """First-order covariance of the noise in the tangent space of the moved pose, slips included."""
        first, drive, second = split_motion(control)
        sigmas = self._sigmas(first, drive, second)
        calm, wild = (self._spread(control, sigmas, drive, slipping) for slipping in (False, True))
        return (1.0 - self.slip) * calm + self.slip * wild

    def log_prob(self, state: SE2, control: SE2, moved: SE2) -> Float[Array, ""]:
        """Log density of a next pose: a mixture of two normals, with and without slipping, to first order."""
        first, drive, second = split_motion(control)
        sigmas = self._sigmas(first, drive, second)
        deviation, mask = local(self.move(state, control), moved), jnp.ones(3, bool)
        calm, wild = (log_normal(deviation, self._spread(control, sigmas, drive, s), mask) for s in (False, True))
        tiny = float(jnp.finfo(self.slip.dtype).tiny)
        odds = jnp.log(jnp.maximum(jnp.stack([1.0 - self.slip, self.slip]), tiny))
        return jnp.logaddexp(calm + odds[0], wild + odds[1])

    def _sigmas(self, first: Array, drive: Array, second: Array) -> tuple[Array, Array, Array]:
        turn = (self.turn_drive * drive) ** 2 + self.turn_floor**2
        along = (self.drive_drive * drive) ** 2 + self.drive_turn**2 * (first**2 + second**2) + self.drive_floor**2
        squares = (turn + (self.turn_turn * first) ** 2, along, turn + (self.turn_turn * second) ** 2)
        return tuple(jnp.sqrt(square + 1e-12) for square in squares)

    def _slipping(self, drive: Array, sigma: Array) -> Array:
        return jnp.sqrt(sigma**2 + (self.slip_scale * drive) ** 2)

    def _spread(self, control: SE2, sigmas: tuple[Array, Array, Array], drive: Array, slipping: bool) -> Array:
        """``J diag(sigma^2) J^T`` with J from (r1, s, r2) to the tangent of the moved pose."""
        heading, zero = control.rotation.inverse(), jnp.zeros_like(drive)
        x, y = control.translation[0], control.translation[1]
        first, _, _ = split_motion(control)
        # In the frame before: a turn of r1 moves the end sideways, distance moves it along; then into the frame after.
        columns = jnp.stack([jnp.stack([-y, x]), jnp.stack([jnp.cos(first), jnp.sin(first)])], axis=1)
        upper = jnp.concatenate([matmul(heading.matrix(), columns), zero[None, None] * columns[:, :1]], axis=1)
        jacobian = jnp.concatenate([upper, jnp.array([[1.0, 0.0, 1.0]], upper.dtype)])
        along = self._slipping(drive, sigmas[1]) if slipping else sigmas[1]
        scaled = jacobian * jnp.stack([sigmas[0], along, sigmas[2]])[None, :]
        return matmul(scaled, scaled.T) + jnp.eye(3, dtype=scaled.dtype) * 1e-8


class DifferentialDrive(Motion):
    """Motion of a robot with two driven wheels, by what each wheel has rolled.

    The control is "2" the paths of the left and right wheel, m; the robot follows the arc between them. Each path errs
    by ``sigma^2 = slip^2 |path| + floor^2``, as if every bit of the way erred by itself.

    Args:
        track: distance between the wheels, m.
        slip: m of noise at a meter of way.
        floor: noise of each wheel at rest, m.

    References:
        Siegwart, Nourbakhsh, *Introduction to Autonomous Mobile Robots*, 2004, section 5.2.4.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> drive = jl.sensors.DifferentialDrive(track=0.5)
        >>> turned = drive.move(jl.poses.SE2(0.0, 0.0, 0.0), jnp.array([-0.25, 0.25]))
        >>> float(turned.theta)
        1.0
    """

    track: Float[Array, ""]
    slip: Float[Array, ""]
    floor: Float[Array, ""]

    def __init__(self, track: Any, *, slip: Any = 0.02, floor: Any = 0.001, dtype: Any = float):
        self.track, self.slip, self.floor = (jnp.asarray(value, dtype) for value in (track, slip, floor))

    def move(self, state: SE2, control: Float[Array, "2"]) -> SE2:
        """The pose at the end of the arc."""
        return state @ self._arc(control)

    def noise_dimension(self, state: SE2) -> int:
        """One number a wheel."""
        return 2

    def perturb(self, state: SE2, control: Float[Array, "2"], normal: Float[Array, "2"]) -> SE2:
        """The pose that the wheels lead to when their paths err by standard normal numbers of sigmas."""
        return state @ self._arc(control + self._sigmas(control) * normal)

    def covariance(self, state: SE2, control: Float[Array, "2"]) -> Float[Array, "3 3"]:
        """First-order covariance in the tangent space of the moved pose; a plane of it is empty but for rounding."""
        angle = (control[1] - control[0]) / self.track
        half = SE2.left_jacobian(-jnp.stack([jnp.mean(control), 0.0 * angle, angle]))
        wheels = jnp.array([[0.5, 0.5], [0.0, 0.0]], control.dtype)
        turn = jnp.stack([-1.0 / self.track, 1.0 / self.track])[None, :]
        scaled = matmul(half, jnp.concatenate([wheels, turn])) * self._sigmas(control)[None, :]
        return matmul(scaled, scaled.T) + jnp.eye(3, dtype=control.dtype) * 1e-8

    def _arc(self, control: Array) -> SE2:
        angle = (control[1] - control[0]) / self.track
        return SE2.exp(jnp.stack([jnp.mean(control), 0.0 * angle, angle]))

    def _sigmas(self, control: Array) -> Array:
        return jnp.sqrt(self.slip**2 * jnp.abs(control) + self.floor**2 + 1e-12)


def split_motion(motion: SE2) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """A relative pose as turn, distance and turn; the distance is negative where it drove backwards.

    Args:
        motion: ``T_before_after``.

    Returns:
        First turn (rad), distance (m, negative backwards), second turn (rad). A way below 1 cm has no first turn.

    Example:
        >>> import jaxloc as jl
        >>> [round(float(part), 3) for part in jl.sensors.odometer.split_motion(jl.poses.SE2(-1.0, -0.0, 0.5))]
        [0.0, -1.0, 0.5]
    """
    x, y = motion.translation[0], motion.translation[1]
    squared = x * x + y * y
    moved = squared > _NO_WAY**2
    length = jnp.sqrt(jnp.where(moved, squared, 1.0))
    forward = jnp.where(x < 0, -1.0, 1.0).astype(x.dtype)
    first = jnp.where(moved, jnp.arctan2(forward * jnp.where(moved, y, 0.0), jnp.where(moved, forward * x, 1.0)), 0.0)
    second = motion.theta - first
    second = jnp.arctan2(jnp.sin(second), jnp.cos(second))
    return first, jnp.where(moved, forward * length, x), second


def falls_below(normal: Float[Array, "*n"], probability: Float[Array, ""]) -> Bool[Array, "*n"]:
    """Whether standard normal numbers fall into their lowest quantile of a probability.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> bool(jl.sensors.odometer.falls_below(jnp.array(-2.0), jnp.array(0.05)))
        True
    """
    return 0.5 * (1.0 + erf(normal / math.sqrt(2.0))) < probability
