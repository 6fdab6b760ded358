"""Odometry motion models: rotation-translation-rotation with wheel slip, and differential drive."""

import math
from typing import Any

import jax.numpy as jnp
from jax.scipy.special import erf
from jaxtyping import Array, Bool, Float

from jaxloc._arguments import checked
from jaxloc._linalg import matmul
from jaxloc.beliefs.models import Motion, log_normal
from jaxloc.poses import SE2, local

_LEAST_DISTANCE = 0.01  # below it, the direction of motion is undefined, m


class OdometryMotion(Motion):
    """Odometry motion model: a turn, a translation and a second turn, each with its own noise.

    The control is the relative pose ``u = T_before_after`` of the odometry, split into a turn r1, a distance s and a
    turn r2. Their standard deviations are::

        sigma_r1^2 = turn_turn^2 r1^2 + turn_drive^2 s^2 + turn_floor^2        (r2 alike)
        sigma_s^2  = drive_drive^2 s^2 + drive_turn^2 (r1^2 + r2^2) + drive_floor^2

    Turns are relative to the nearer end of the robot, so that driving backwards is not a turn by pi. With probability
    `slip` the error of the distance has the standard deviation `slip_scale` times the distance: wheels slip, or the
    robot is pushed. Without such tails a single outlier step loses the robot.

    Args:
        turn_turn: standard deviation of a turn, rad per rad (Thrun's alpha_1).
        turn_drive: standard deviation of a turn, rad per m (alpha_2).
        drive_drive: standard deviation of the distance, m per m (alpha_3).
        drive_turn: standard deviation of the distance, m per rad (alpha_4).
        turn_floor: standard deviation of a turn at rest, rad.
        drive_floor: standard deviation of the distance at rest, m.
        slip: probability of wheel slip.
        slip_scale: standard deviation of the distance under slip, as a share of it.

    References:
        Thrun, Burgard, Fox, *Probabilistic Robotics*, 2005, table 5.6 (with standard
        deviations, as here).

    Example:
        >>> import jax, jax.numpy as jnp, jaxloc as jl
        >>> motion = jl.sensors.OdometryMotion(turn_turn=0.1, drive_drive=0.1)
        >>> pose, driven = jl.poses.SE2(0.0, 0.0, jnp.pi / 2), jl.poses.SE2(1.0, 0.0, 0.0)
        >>> motion.move(pose, driven).translation.round(3).tolist()
        [-0.0, 1.0]
        >>> motion.sample(pose, driven, key=jax.random.key(0)).translation.shape
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

    @checked
    def move(self, state: SE2, control: SE2) -> SE2:
        """The pose moved by the odometry."""
        return state @ control

    @checked
    def noise_dimension(self, state: SE2) -> int:
        """Two turns, a distance, and one number that decides on slip."""
        return 4

    @checked
    def perturb(self, state: SE2, control: SE2, normal: Float[Array, "4"]) -> SE2:
        """The next pose for standard normal numbers."""
        first, drive, second = split_motion(control)
        sigma_first, sigma_drive, sigma_second = self._sigmas(first, drive, second)
        slips = falls_below(normal[3], self.slip)
        sigma_drive = jnp.where(slips, self._slipping(drive, sigma_drive), sigma_drive)
        turned = first + sigma_first * normal[0]
        length = drive + sigma_drive * normal[1]
        # The error is added to the reported motion, so that a step without noise is exact, also at rest.
        x = control.translation[0] + length * jnp.cos(turned) - drive * jnp.cos(first)
        y = control.translation[1] + length * jnp.sin(turned) - drive * jnp.sin(first)
        turn = SE2(0.0 * x, 0.0 * x, sigma_first * normal[0] + sigma_second * normal[2])
        return state @ SE2.from_parts(control.rotation.compose(turn.rotation), jnp.stack([x, y]))

    @checked
    def covariance(self, state: SE2, control: SE2) -> Float[Array, "3 3"]:
        """First-order covariance of the noise in the tangent space of the moved pose, slip included."""
        first, drive, second = split_motion(control)
        sigmas = self._sigmas(first, drive, second)
        normal, slipped = (self._component(control, sigmas, drive, slipping) for slipping in (False, True))
        return (1.0 - self.slip) * normal + self.slip * slipped

    @checked
    def log_prob(self, state: SE2, control: SE2, moved: SE2) -> Float[Array, ""]:
        """Log density of a next pose: a mixture of two normals, with and without slip, to first order."""
        first, drive, second = split_motion(control)
        sigmas = self._sigmas(first, drive, second)
        deviation, mask = local(self.move(state, control), moved), jnp.ones(3, bool)
        normal, slipped = (
            log_normal(deviation, self._component(control, sigmas, drive, slipping), mask) for slipping in (False, True)
        )
        tiny = float(jnp.finfo(self.slip.dtype).tiny)
        odds = jnp.log(jnp.maximum(jnp.stack([1.0 - self.slip, self.slip]), tiny))
        return jnp.logaddexp(normal + odds[0], slipped + odds[1])

    def _sigmas(self, first: Array, drive: Array, second: Array) -> tuple[Array, Array, Array]:
        turn = (self.turn_drive * drive) ** 2 + self.turn_floor**2
        along = (self.drive_drive * drive) ** 2 + self.drive_turn**2 * (first**2 + second**2) + self.drive_floor**2
        squares = (turn + (self.turn_turn * first) ** 2, along, turn + (self.turn_turn * second) ** 2)
        return tuple(jnp.sqrt(square + 1e-12) for square in squares)

    def _slipping(self, drive: Array, sigma: Array) -> Array:
        return jnp.sqrt(sigma**2 + (self.slip_scale * drive) ** 2)

    def _component(self, control: SE2, sigmas: tuple[Array, Array, Array], drive: Array, slipping: bool) -> Array:
        """``J diag(sigma^2) J^T`` with J from (r1, s, r2) to the tangent of the moved pose."""
        heading, zero = control.rotation.inverse(), jnp.zeros_like(drive)
        x, y = control.translation[0], control.translation[1]
        first, _, _ = split_motion(control)
        # In the frame before, r1 moves the end sideways and s along the motion; then rotated into the frame after.
        columns = jnp.stack([jnp.stack([-y, x]), jnp.stack([jnp.cos(first), jnp.sin(first)])], axis=1)
        upper = jnp.concatenate([matmul(heading.matrix(), columns), zero[None, None] * columns[:, :1]], axis=1)
        jacobian = jnp.concatenate([upper, jnp.array([[1.0, 0.0, 1.0]], upper.dtype)])
        along = self._slipping(drive, sigmas[1]) if slipping else sigmas[1]
        scaled = jacobian * jnp.stack([sigmas[0], along, sigmas[2]])[None, :]
        return matmul(scaled, scaled.T) + jnp.eye(3, dtype=scaled.dtype) * 1e-8


class DifferentialDrive(Motion):
    """Differential drive: motion of a robot with two driven wheels on an arc.

    The control is "2", the distances of the left and right wheel, m. The variance of each is ``slip^2 |distance| +
    floor^2``: errors along the path are independent.

    Args:
        track: distance between the wheels, m.
        slip: standard deviation of a wheel's distance after 1 m, m.
        floor: standard deviation of a wheel's distance at rest, m.

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

    @checked
    def move(self, state: SE2, control: Float[Array, "2"]) -> SE2:
        """The pose at the end of the arc."""
        return state @ self._arc(control)

    @checked
    def noise_dimension(self, state: SE2) -> int:
        """One number per wheel."""
        return 2

    @checked
    def perturb(self, state: SE2, control: Float[Array, "2"], normal: Float[Array, "2"]) -> SE2:
        """The next pose for standard normal numbers, one for each wheel."""
        return state @ self._arc(control + self._sigmas(control) * normal)

    @checked
    def covariance(self, state: SE2, control: Float[Array, "2"]) -> Float[Array, "3 3"]:
        """First-order covariance in the tangent space of the moved pose, of rank two but for rounding."""
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


@checked
def split_motion(motion: SE2) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """A relative pose as turn, distance and turn; the distance is negative for backward motion.

    Args:
        motion: ``T_before_after``.

    Returns:
        First turn (rad), distance (m, negative backwards), second turn (rad). The first turn is zero below 1 cm.

    Example:
        >>> import jaxloc as jl
        >>> [round(float(part), 3) for part in jl.sensors.odometer.split_motion(jl.poses.SE2(-1.0, -0.0, 0.5))]
        [0.0, -1.0, 0.5]
    """
    x, y = motion.translation[0], motion.translation[1]
    squared = x * x + y * y
    moved = squared > _LEAST_DISTANCE**2
    length = jnp.sqrt(jnp.where(moved, squared, 1.0))
    forward = jnp.where(x < 0, -1.0, 1.0).astype(x.dtype)
    first = jnp.where(moved, jnp.arctan2(forward * jnp.where(moved, y, 0.0), jnp.where(moved, forward * x, 1.0)), 0.0)
    second = motion.theta - first
    second = jnp.arctan2(jnp.sin(second), jnp.cos(second))
    return first, jnp.where(moved, forward * length, x), second


@checked
def falls_below(normal: Float[Array, "*n"], probability: Float[Array, ""]) -> Bool[Array, "*n"]:
    """Whether standard normal numbers fall into their lowest quantile of a probability.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> bool(jl.sensors.odometer.falls_below(jnp.array(-2.0), jnp.array(0.05)))
        True
    """
    return 0.5 * (1.0 + erf(normal / math.sqrt(2.0))) < probability
