"""Motion models: linear, constant velocity, constant acceleration, coordinated turn, and poses driven by twists."""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxloc._linalg import matmul
from jaxloc.beliefs import Motion
from jaxloc.poses import retract, series, tangent_dimension
from jaxloc.poses.lie_group import Group, as_floats


class LinearMotion(Motion):
    """Linear motion ``x' = F x + B u + w``, ``w ~ N(0, Q)``, the same at every step.

    Args:
        transition: F.
        noise_covariance: Q.
        input_matrix: B; None for no input (the control is then ignored, and may be None).

    References:
        Kalman, "A new approach to linear filtering and prediction problems", 1960 [T-56].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> motion = jl.filters.LinearMotion(jnp.array([[1.0, 0.5], [0.0, 1.0]]), jnp.eye(2))
        >>> motion.move(jnp.array([0.0, 2.0]), None).tolist()
        [1.0, 2.0]
    """

    transition: Float[Array, "d d"]
    noise_covariance: Float[Array, "d d"]
    input_matrix: Float[Array, "d u"] | None = None

    def move(self, state: Float[Array, " d"], control: Any) -> Float[Array, " d"]:
        """``F x + B u``."""
        moved = matmul(self.transition, state)
        return moved if self.input_matrix is None else moved + matmul(self.input_matrix, control)

    def covariance(self, state: Float[Array, " d"], control: Any) -> Float[Array, "d d"]:
        """Q."""
        del state, control
        return self.noise_covariance

    def linearize(self, state: Float[Array, " d"], control: Any) -> tuple[Float[Array, " d"], Float[Array, "d d"]]:
        """The moved state and F."""
        return self.move(state, control), self.transition


class _Kinematic(Motion):
    """A chain of derivatives along each axis, driven by white noise on the highest: linear, with the step as control.

    Attributes:
        intensity: spectral density of the noise.
        axes: number of spatial axes.
        padding: trailing entries of the state that this model holds at zero.
    """

    intensity: Float[Array, "*axes"]
    axes: int = eqx.field(static=True)
    padding: int = eqx.field(static=True)

    def __init__(self, intensity: Any, axes: int = 2, padding: int = 0):
        (self.intensity,) = as_floats(intensity)
        self.axes, self.padding = axes, padding

    @abstractmethod
    def chain(self, dt: Float[Array, ""]) -> tuple[Float[Array, "k k"], Float[Array, "k k"]]:
        """Transition of one axis, and covariance of its noise at unit intensity."""

    def move(self, state: Float[Array, " d"], control: Float[Array, ""]) -> Float[Array, " d"]:
        """The state after `control` seconds."""
        return self.linearize(state, control)[0]

    def covariance(self, state: Float[Array, " d"], control: Float[Array, ""]) -> Float[Array, "d d"]:
        """Covariance of the noise accumulated in `control` seconds."""
        intensity = jnp.broadcast_to(self.intensity, (self.axes,)).astype(state.dtype)
        noise = self.chain(control.astype(state.dtype))[1]
        return self._padded(noise[:, None, :, None] * jnp.diag(intensity)[None, :, None, :])

    def linearize(
        self, state: Float[Array, " d"], control: Float[Array, ""]
    ) -> tuple[Float[Array, " d"], Float[Array, "d d"]]:
        """The moved state and its transition matrix."""
        transition = self.chain(control.astype(state.dtype))[0]
        eye = jnp.eye(self.axes, dtype=state.dtype)
        jacobian = self._padded(transition[:, None, :, None] * eye[None, :, None, :])
        if state.shape[0] != jacobian.shape[0]:
            raise ValueError(
                f"{type(self).__name__} with {self.axes} axes and padding {self.padding} moves states of "
                f"{jacobian.shape[0]} entries; it got {state.shape[0]}."
            )
        return matmul(jacobian, state), jacobian

    def _padded(self, blocks: Float[Array, "k a k a"]) -> Float[Array, "d d"]:
        size = blocks.shape[0] * blocks.shape[1]
        return jnp.pad(blocks.reshape(size, size), (0, self.padding))


class ConstantVelocity(_Kinematic):
    """White-noise acceleration: the state is positions, then velocities; the control is the step ``dt``, s.

    Args:
        intensity: spectral density q of the acceleration, m^2/s^3; scalar or one for each axis.
        axes: number of spatial axes.
        padding: trailing entries of the state (such as accelerations, for a bank of models) held at zero.

    References:
        Bar-Shalom, Li, Kirubarajan, *Estimation with Applications*, 2001, section 6.2.2 [T-6].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> motion = jl.filters.ConstantVelocity(0.1, axes=2)
        >>> motion.move(jnp.array([0.0, 0.0, 1.0, 2.0]), jnp.array(0.5)).tolist()
        [0.5, 1.0, 1.0, 2.0]
    """

    def chain(self, dt: Float[Array, ""]) -> tuple[Float[Array, "2 2"], Float[Array, "2 2"]]:
        """Transition and noise of one axis."""
        one, zero = jnp.ones_like(dt), jnp.zeros_like(dt)
        return _matrix((one, dt), (zero, one)), _matrix((dt**3 / 3.0, dt**2 / 2.0), (dt**2 / 2.0, dt))


class ConstantAcceleration(_Kinematic):
    """White-noise jerk: the state is positions, velocities, accelerations; the control is the step ``dt``, s.

    Args:
        intensity: spectral density q of the jerk, m^2/s^5; scalar or one for each axis.
        axes: number of spatial axes.
        padding: trailing entries of the state held at zero.

    References:
        Bar-Shalom, Li, Kirubarajan, *Estimation with Applications*, 2001, section 6.2.3 [T-6].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> motion = jl.filters.ConstantAcceleration(0.1, axes=1)
        >>> motion.move(jnp.array([0.0, 1.0, 2.0]), jnp.array(1.0)).tolist()
        [2.0, 3.0, 2.0]
    """

    def chain(self, dt: Float[Array, ""]) -> tuple[Float[Array, "3 3"], Float[Array, "3 3"]]:
        """Transition and noise of one axis."""
        one, zero = jnp.ones_like(dt), jnp.zeros_like(dt)
        transition = _matrix((one, dt, 0.5 * dt**2), (zero, one, dt), (zero, zero, one))
        noise = _matrix(
            (dt**5 / 20.0, dt**4 / 8.0, dt**3 / 6.0),
            (dt**4 / 8.0, dt**3 / 3.0, dt**2 / 2.0),
            (dt**3 / 6.0, dt**2 / 2.0, dt),
        )
        return transition, noise


class CoordinatedTurn(Motion):
    """Coordinated turn: the state is x, y, its velocity, and the turn rate; the control is the step ``dt``, s.

    Value and gradients are exact at a turn rate of zero, too.

    Args:
        intensity: spectral density of the acceleration, m^2/s^3.
        turn_intensity: spectral density of the turn rate's change, rad^2/s^3.

    References:
        Bar-Shalom, Li, Kirubarajan, *Estimation with Applications*, 2001, section 11.7.1 [T-6].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> motion = jl.filters.CoordinatedTurn(0.0, 0.1)
        >>> moved = motion.move(jnp.array([0.0, 0.0, 1.0, 0.0, jnp.pi / 2]), jnp.array(1.0))
        >>> [round(float(number), 2) for number in moved]
        [0.64, 0.64, -0.0, 1.0, 1.57]
    """

    intensity: Float[Array, ""]
    turn_intensity: Float[Array, ""]

    def __init__(self, intensity: Any, turn_intensity: Any):
        self.intensity, self.turn_intensity = as_floats(intensity, turn_intensity)

    def move(self, state: Float[Array, "5"], control: Float[Array, ""]) -> Float[Array, "5"]:
        """The state after `control` seconds."""
        velocity, rate = state[2:4], state[4]
        angle = rate * control
        across = jnp.stack([-velocity[1], velocity[0]])
        along = series.sinc(angle**2)
        lateral = angle * series.versine(angle**2)
        position = state[:2] + control * (along * velocity + lateral * across)
        turned = jnp.cos(angle) * velocity + jnp.sin(angle) * across
        return jnp.concatenate([position, turned, rate[None]])

    def covariance(self, state: Float[Array, "5"], control: Float[Array, ""]) -> Float[Array, "5 5"]:
        """Covariance of the noise accumulated in `control` seconds."""
        straight = ConstantVelocity(self.intensity, axes=2, padding=1).covariance(state, control)
        return straight.at[4, 4].set(self.turn_intensity.astype(state.dtype) * control)


class BodyTwist(eqx.Module):
    """Control of `TwistMotion`: a constant twist for one step.

    Attributes:
        twist: velocity in the body frame, (translation, rotation), m/s and rad/s.
        dt: duration, s.
    """

    twist: Float[Array, "*t d"]
    dt: Float[Array, "*t"]


class TwistMotion(Motion):
    """A pose driven by its velocity in the body frame: ``T' = T exp(u dt) exp(w)``, ``w ~ N(0, Q dt)``.

    Args:
        intensity: Q, spectral density of the noise in the tangent space of the pose, "d d", m^2/s and rad^2/s.

    References:
        Barfoot, *State Estimation for Robotics*, 2017, section 8.2 [K-79].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> motion = jl.filters.TwistMotion(0.01 * jnp.eye(3))
        >>> step = jl.filters.BodyTwist(jnp.array([1.0, 0.0, jnp.pi]), jnp.array(0.5))
        >>> round(float(motion.move(jl.poses.SE2.identity(), step).theta), 3)
        1.571
    """

    intensity: Float[Array, "d d"]

    def move(self, state: Group, control: BodyTwist) -> Group:
        """``T exp(u dt)``."""
        return retract(state, control.twist * control.dt)

    def covariance(self, state: Group, control: BodyTwist) -> Float[Array, "d d"]:
        """``Q dt``."""
        del state
        return self.intensity * control.dt

    def linearize(self, state: Group, control: BodyTwist) -> tuple[Group, Float[Array, "d d"]]:
        """The moved pose and ``Ad(exp(-u dt))``."""
        if tangent_dimension(state) != control.twist.shape[-1]:
            raise ValueError(
                f"A {type(state).__name__} takes a twist of {tangent_dimension(state)} entries; "
                f"it got {control.twist.shape[-1]}."
            )
        return self.move(state, control), type(state).exp(-control.twist * control.dt).adjoint()


def _matrix(*rows: tuple[Array, ...]) -> Array:
    return jnp.stack([jnp.stack(row) for row in rows])
