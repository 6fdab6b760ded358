"""SE(2): poses in the plane."""

from typing import Any, ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxloc._arguments import checked
from jaxloc._linalg import matmul
from jaxloc.poses import series
from jaxloc.poses.lie_group import Group, as_floats, bounded, largest_angle, largest_length, unless
from jaxloc.poses.so2 import SO2


class SE2(Group):
    """A planar pose: x forward, y left, heading theta counter-clockwise (m, m, rad).

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> T_world_robot = jl.poses.SE2(1.0, 2.0, jnp.pi / 2)
        >>> bool(jnp.allclose(T_world_robot.apply(jnp.array([[1.0, 0.0]])), jnp.array([[1.0, 3.0]])))
        True
    """

    rotation: SO2
    translation: Float[Array, "2"]

    dof: ClassVar[int] = 3
    labels: ClassVar[tuple[str, ...]] = ("x", "y", "rotation")

    def __init__(self, x: Any, y: Any, theta: Any):
        x, y, theta = as_floats(x, y, theta)
        self.rotation = SO2.from_angle(theta)
        self.translation = jnp.stack([x, y])

    @staticmethod
    @checked
    def from_parts(rotation: SO2, translation: Float[Array, "2"]) -> "SE2":
        """Pose of a rotation and a translation, without an angle in between."""
        pose = object.__new__(SE2)
        object.__setattr__(pose, "rotation", rotation)
        object.__setattr__(pose, "translation", translation)
        return pose

    @staticmethod
    @checked
    def from_matrix(matrix: Float[Array, "3 3"]) -> "SE2":
        """Pose of a homogeneous matrix."""
        return SE2.from_parts(SO2(matrix[0, 0], matrix[1, 0]), matrix[:2, 2])

    @staticmethod
    def identity(dtype: Any = float) -> "SE2":
        """The pose of the origin."""
        return SE2.from_parts(SO2.identity(dtype), jnp.zeros(2, dtype))

    @staticmethod
    @checked
    def exp(xi: Float[Array, "3"]) -> "SE2":
        """Exponential map: the pose reached by the constant twist (v_x, v_y, omega) in unit time."""
        finite, (v, theta) = bounded((xi[:2], largest_length(xi.dtype)), (xi[2], largest_angle(xi.dtype)))
        s = theta * theta
        a, b = series.sinc(s), theta * series.versine(s)
        translation = jnp.stack([a * v[0] - b * v[1], b * v[0] + a * v[1]])
        return unless(finite, SE2.from_parts(SO2.from_angle(theta), translation))

    @staticmethod
    @checked
    def left_jacobian(xi: Float[Array, "3"]) -> Float[Array, "3 3"]:
        """``J`` with ``exp(xi + d) ~ exp(J d) @ exp(xi)``; the right one is ``left_jacobian(-xi)``."""
        theta = xi[2]
        s = theta * theta
        a, b, c = series.sinc(s), series.versine(s), theta * series.third(s)
        zero, one = jnp.zeros_like(theta), jnp.ones_like(theta)
        rows = (
            (a, -theta * b, c * xi[0] + b * xi[1]),
            (theta * b, a, c * xi[1] - b * xi[0]),
            (zero, zero, one),
        )
        return jnp.stack([jnp.stack(row) for row in rows])

    @staticmethod
    @checked
    def left_jacobian_inverse(xi: Float[Array, "3"]) -> Float[Array, "3 3"]:
        """Inverse of `left_jacobian`, for angles below 2 pi."""
        jacobian = SE2.left_jacobian(xi)
        inverse = _inverse_mean_rotation(xi[2])
        column = -matmul(inverse, jacobian[:2, 2:])
        return jnp.concatenate([jnp.concatenate([inverse, column], axis=1), jacobian[2:]])

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Leading axes of a stack."""
        return self.translation.shape[:-1]

    @property
    def x(self) -> Float[Array, ""]:
        """Position forward, m."""
        return self.translation[0]

    @property
    def y(self) -> Float[Array, ""]:
        """Position left, m."""
        return self.translation[1]

    @property
    def theta(self) -> Float[Array, ""]:
        """Heading in (-pi, pi], rad."""
        return self.rotation.angle()

    def log(self) -> Float[Array, "3"]:
        """Logarithm: the twist that reaches this pose in unit time."""
        cos, sin, room = self.rotation.cos, self.rotation.sin, largest_length(self.translation.dtype)
        finite, (cos, sin, translation) = bounded((cos, 4.0), (sin, 4.0), (self.translation, room))
        theta = SO2(cos, sin).angle()
        linear = matmul(_inverse_mean_rotation(theta), translation)
        return unless(finite, jnp.concatenate([linear, theta[None]]))

    @checked
    def compose(self, other: "SE2") -> "SE2":
        """``T_a_b @ T_b_c = T_a_c``."""
        rotated = matmul(self.rotation.matrix(), other.translation)
        return SE2.from_parts(self.rotation.compose(other.rotation), self.translation + rotated)

    @checked
    def retract(self, delta: Float[Array, "3"]) -> "SE2":
        """``T @ exp(delta)``."""
        return self.compose(SE2.exp(delta))

    def inverse(self) -> "SE2":
        """The inverse."""
        rotation = self.rotation.inverse()
        return SE2.from_parts(rotation, -matmul(rotation.matrix(), self.translation))

    def matrix(self) -> Float[Array, "3 3"]:
        """Homogeneous matrix."""
        top = jnp.concatenate([self.rotation.matrix(), self.translation[:, None]], axis=1)
        return jnp.concatenate([top, jnp.array([[0, 0, 1]], top.dtype)])

    def adjoint(self) -> Float[Array, "3 3"]:
        """The matrix with ``T @ exp(d) == exp(adjoint @ d) @ T``."""
        column = jnp.stack([self.y, -self.x])[:, None]
        top = jnp.concatenate([self.rotation.matrix(), column], axis=1)
        return jnp.concatenate([top, jnp.array([[0, 0, 1]], top.dtype)])

    @checked
    def apply(self, points: Float[Array, "n 2"]) -> Float[Array, "n 2"]:
        """Points of the inner frame in the outer frame."""
        return self.rotation.apply(points) + self.translation[None, :]

    def normalize(self) -> "SE2":
        """The pose with its rotation normalized."""
        return SE2.from_parts(self.rotation.normalize(), self.translation)


def _inverse_mean_rotation(theta: Float[Array, ""]) -> Float[Array, "2 2"]:
    """Inverse of the mean of the rotations from 0 to theta, which maps a twist's velocity to a translation."""
    diagonal = 1.0 - theta * theta * series.cotangent(theta * theta)
    half = 0.5 * theta
    return jnp.stack([jnp.stack([diagonal, half]), jnp.stack([-half, diagonal])])
