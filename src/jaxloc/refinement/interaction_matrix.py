"""Interaction matrix of image points, and least-squares problems of camera motion from optical flow.

The model is described in `motion_from_flow` [K-78].
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxloc._arguments import checked
from jaxloc._jit import filter_jit
from jaxloc._linalg import matmul
from jaxloc.poses import Direction
from jaxloc.solvers import Linearization, Problem, Quadratic
from jaxloc.solvers.cholesky import factor

# Least ratio of the variance explained by depths and translation to the residual variance; a few for noise alone.
_LEAST_RATIO = 8.0


class FreeMotion(eqx.Module):
    """Camera motion up to scale: what flow without depth determines.

    Attributes:
        direction: of the translation, camera axes.
        angular_velocity: rad/s (or rad an image, if flow is a displacement), camera axes.
    """

    direction: Direction
    angular_velocity: Float[Array, "3"]


class TwistAndDepths(eqx.Module):
    """A twist and the inverse depths of the points.

    Attributes:
        twist: (v, w), camera axes.
        inverse_depths: 1/m.
    """

    twist: Float[Array, "6"]
    inverse_depths: Float[Array, " n"]


class FlowOfTwist(Problem):
    """Flow with known depth; the state is the twist "6", or the rotation "3" alone where depth is infinite.

    Attributes:
        interaction: "d 2 n", derivative of the flow by the state.
        flow: "2 n", finite.
        whitening: one over the standard deviation of a component; zero for masked points.
        loss: robust kernel over the two components of a point.
    """

    interaction: Float[Array, "d 2 n"]
    flow: Float[Array, "2 n"]
    whitening: Float[Array, " n"]
    loss: Any = Quadratic()

    def residual(self, state: Float[Array, " d"]) -> Float[Array, "2 n"]:
        """Whitened difference of predicted and measured flow."""
        predicted = jnp.tensordot(state, self.interaction, 1, precision="highest")
        return (predicted - self.flow) * self.whitening[None, :]

    def linearize(self, state: Float[Array, " d"]) -> Linearization:
        """The Jacobian does not depend on the state."""
        return Linearization(self.residual(state), self.interaction * self.whitening[None, None, :])


class JointFlow(Problem):
    """Flow with unknown or uncertain depths; the state is `TwistAndDepths`.

    Without a `depth_whitening` above zero the scale is unobservable [K-88].

    Attributes:
        points: "2 n", normalized.
        flow: "2 n".
        whitening: one over the standard deviation of a component of the flow.
        inverse_depths: measured, 1/m.
        depth_whitening: one over their standard deviations; zero where there is no measurement.
        loss: robust kernel.
    """

    points: Float[Array, "2 n"]
    flow: Float[Array, "2 n"]
    whitening: Float[Array, " n"]
    inverse_depths: Float[Array, " n"]
    depth_whitening: Float[Array, " n"]
    loss: Any = Quadratic()

    def residual(self, state: TwistAndDepths) -> tuple[Float[Array, "2 n"], Float[Array, "1 n"]]:
        """Whitened differences of flow and of inverse depths."""
        linear, angular = flow_parts(self.points)
        v, w = state.twist[:3], state.twist[3:]
        shift = jnp.tensordot(v, linear, 1, precision="highest") * state.inverse_depths[None, :]
        error = shift + jnp.tensordot(w, angular, 1, precision="highest") - self.flow
        depth = (state.inverse_depths - self.inverse_depths) * self.depth_whitening
        return error * self.whitening[None, :], depth[None, :]


class DirectionalFlow(Problem):
    """Flow with the depths eliminated; the state is `FreeMotion`.

    A translation moves a point along its line through the focus of expansion, by an amount that depends on the unknown
    depth. The residual is the component of the flow, less that of the rotation, across this line.

    Attributes:
        points: "2 n", normalized.
        flow: "2 n".
        whitening: one over the standard deviation of a component; zero for masked points.
        loss: robust kernel.
    """

    points: Float[Array, "2 n"]
    flow: Float[Array, "2 n"]
    whitening: Float[Array, " n"]
    loss: Any = Quadratic()

    def residual(self, state: FreeMotion) -> Float[Array, "1 n"]:
        """Whitened flow across the lines to the focus of expansion."""
        return (self._split(state.direction.vector, state.angular_velocity)[1] * self.whitening)[None, :]

    def linearize(self, state: FreeMotion) -> Linearization:
        """In closed form: the derivative of the normal multiplies the flow along the line."""
        linear, angular = flow_parts(self.points)
        along, normal, size = _normal(linear, state.direction.vector)
        left = self.flow - jnp.tensordot(state.angular_velocity, angular, 1, precision="highest")
        tangents = jnp.tensordot(state.direction.basis().T, linear, 1, precision="highest")
        turn = jnp.sum(normal[None] * tangents, axis=1) / size[None, :]
        by_direction = -turn * jnp.sum(along * left, axis=0)[None, :]
        by_rotation = -jnp.sum(normal[None] * angular, axis=1)
        jacobian = jnp.concatenate([by_direction, by_rotation]) * self.whitening[None, :]
        return Linearization(self.residual(state), jacobian[:, None, :])

    def admissible(self, state: FreeMotion) -> Bool[Array, ""]:
        """Whether pure rotation explains the flow clearly worse, by the ratio of variances."""
        _, across = self._split(state.direction.vector, state.angular_velocity)
        number = jnp.sum(jnp.where(self.whitening > 0, 1.0, 0.0).astype(across.dtype))
        left = jnp.sum((self.whitening * across) ** 2)
        rows = (flow_parts(self.points)[1] * self.whitening[None, None, :]).reshape(3, -1)
        flow = (self.flow * self.whitening[None, :]).reshape(-1)
        turning = factor(matmul(rows, rows.T)).solve(matmul(rows, flow))
        gain = jnp.sum((flow - matmul(turning, rows)) ** 2) - left
        rounding = jnp.sum((100.0 * float(jnp.finfo(flow.dtype).eps) * flow) ** 2)
        noise = left / jnp.maximum(number - 5.0, 1.0)
        return (number >= 5) & (gain > _LEAST_RATIO * (number + 2.0) * noise + rounding)

    def excess_in_front(self, state: FreeMotion) -> Float[Array, ""]:
        """Number of points in front of the camera less the number behind it."""
        along, _ = self._split(state.direction.vector, state.angular_velocity)
        return jnp.sum(jnp.sign(along) * jnp.where(self.whitening > 0, 1.0, 0.0))

    def _split(self, direction: Array, rotation: Array) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
        """Flow less that of a rotation, along and across the flow of a translation."""
        linear, angular = flow_parts(self.points)
        along, normal, _ = _normal(linear, direction)
        left = self.flow - jnp.tensordot(rotation, angular, 1, precision="highest")
        return jnp.sum(along * left, axis=0), jnp.sum(normal * left, axis=0)

    @checked
    def rotation_for(self, direction: Float[Array, "3"]) -> tuple[Float[Array, "3"], Float[Array, ""]]:
        """The best rotation for a direction of translation, by linear least squares, and its cost."""
        linear, angular = flow_parts(self.points)
        _, normal, _ = _normal(linear, direction)
        rows = jnp.sum(normal[None] * angular, axis=1) * self.whitening[None, :]
        measured = jnp.sum(normal * self.flow, axis=0) * self.whitening
        rotation = factor(matmul(rows, rows.T)).solve(matmul(rows, measured))
        return rotation, jnp.sum((measured - matmul(rotation, rows)) ** 2)


@filter_jit
@checked
def interaction_matrix(points: Float[Array, "n 2"], depth: Float[Array, " n"]) -> Float[Array, "n 2 6"]:
    """Interaction matrix: flow of image points by the twist of the camera, ``flow_k = L_k (v, w)``.

    Args:
        points: normalized coordinates (x right, y down).
        depth: along the optical axis, m; infinite for points of the horizon; zero rows where not positive.

    Returns:
        "n 2 6".

    References:
        KELLY 9.2.4.3.1, ``x' = H rho'`` [K-78].

    Example:
        >>> import jax.numpy as jnp
        >>> interaction_matrix(jnp.array([[1.0, 2.0]]), jnp.array([2.0]))[0].tolist()
        [[-0.5, 0.0, 0.5, 2.0, -2.0, 2.0], [0.0, -0.5, 1.0, 5.0, -2.0, -1.0]]
    """
    linear, angular = flow_parts(points.T)
    positive = depth > 0
    inverse = jnp.where(positive, 1.0 / jnp.where(positive, depth, 1.0), 0.0)
    return jnp.transpose(jnp.concatenate([linear * inverse[None, None, :], angular]), (2, 1, 0))


@checked
def flow_parts(points: Float[Array, "2 n"]) -> tuple[Float[Array, "3 2 n"], Float[Array, "3 2 n"]]:
    """Derivatives of the flow by translation at unit depth, and by rotation: direction first."""
    x, y = points
    one, zero = jnp.ones_like(x), jnp.zeros_like(x)
    linear = ((-one, zero), (zero, -one), (x, y))
    angular = ((x * y, 1.0 + y * y), (-(1.0 + x * x), -x * y), (y, -x))
    return tuple(jnp.stack([jnp.stack(row) for row in rows]) for rows in (linear, angular))


def _normal(linear: Float[Array, "3 2 n"], direction: Float[Array, "3"]) -> tuple[Array, Array, Array]:
    """Unit vectors along and across the flow of a translation, and its size at unit depth; at its focus some pair."""
    shift = jnp.tensordot(direction, linear, 1, precision="highest")
    squared = jnp.sum(shift**2, axis=0)
    moves = squared > 1e-12
    size = jnp.sqrt(jnp.where(moves, squared, 1.0))
    x = jnp.where(moves, shift[0], 1.0) / size
    y = jnp.where(moves, shift[1], 0.0) / size
    return jnp.stack([x, y]), jnp.stack([-y, x]), size
