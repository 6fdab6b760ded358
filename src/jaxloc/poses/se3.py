"""SE(3): poses in space."""

from typing import Any, ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxloc._arguments import checked
from jaxloc._linalg import matmul
from jaxloc.poses import series
from jaxloc.poses.lie_group import Group, as_floats, bounded, largest_angle, largest_length, skew, unless
from jaxloc.poses.so3 import SO3


class SE3(Group):
    """A pose in space: ``x_a = R @ x_b + t`` for ``T_a_b``.

    Tangents are (translation, rotation): ``xi = (v, omega)``, m and rad.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> T = jl.poses.SE3.from_euler(jnp.array([1.0, 2.0, 3.0]), yaw=0.1, pitch=0.2, roll=0.3)
        >>> bool(jnp.allclose((T @ T.inverse()).matrix(), jnp.eye(4), atol=1e-6))
        True
    """

    rotation: SO3
    translation: Float[Array, "3"]

    dof: ClassVar[int] = 6
    labels: ClassVar[tuple[str, ...]] = ("x", "y", "z", "rotation_x", "rotation_y", "rotation_z")

    @staticmethod
    def identity(dtype: Any = float) -> "SE3":
        """The pose of the origin."""
        return SE3(SO3.identity(dtype), jnp.zeros(3, dtype))

    @staticmethod
    @checked
    def from_matrix(matrix: Float[Array, "4 4"]) -> "SE3":
        """Pose of a homogeneous matrix (its rotation is not orthonormalized; see `normalize`)."""
        return SE3(SO3(matrix[:3, :3]), matrix[:3, 3])

    @staticmethod
    def from_euler(translation: Any, yaw: Any, pitch: Any, roll: Any) -> "SE3":
        """Pose of a translation (m) and the Z-Y-X angles (rad) [K-7]."""
        translation, yaw, pitch, roll = as_floats(translation, yaw, pitch, roll)
        return SE3(SO3.from_euler(yaw, pitch, roll), translation)

    @staticmethod
    @checked
    def exp(xi: Float[Array, "6"]) -> "SE3":
        """Exponential map: the pose reached by the constant twist (v, omega) in unit time."""
        finite, (v, omega) = bounded((xi[:3], largest_length(xi.dtype)), (xi[3:], largest_angle(xi.dtype)))
        return unless(finite, SE3(SO3.exp(omega), matmul(SO3.left_jacobian(omega), v)))

    @staticmethod
    @checked
    def left_jacobian(xi: Float[Array, "6"]) -> Float[Array, "6 6"]:
        """``J`` with ``exp(xi + d) ~ exp(J d) @ exp(xi)``; the right one is ``left_jacobian(-xi)``."""
        rotation = SO3.left_jacobian(xi[3:])
        return _block_triangular(rotation, _translation_coupling(xi))

    @staticmethod
    @checked
    def left_jacobian_inverse(xi: Float[Array, "6"]) -> Float[Array, "6 6"]:
        """Inverse of `left_jacobian`, for angles below 2 pi."""
        rotation = SO3.left_jacobian_inverse(xi[3:])
        return _block_triangular(rotation, -matmul(rotation, matmul(_translation_coupling(xi), rotation)))

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Leading axes of a stack."""
        return self.translation.shape[:-1]

    def log(self) -> Float[Array, "6"]:
        """Logarithm: the twist that reaches this pose in unit time."""
        room = largest_length(self.translation.dtype)
        finite, (matrix, translation) = bounded((self.rotation.rotation_matrix, 4.0), (self.translation, room))
        omega = SO3(matrix).log()
        return unless(finite, jnp.concatenate([matmul(SO3.left_jacobian_inverse(omega), translation), omega]))

    @checked
    def compose(self, other: "SE3") -> "SE3":
        """``T_a_b @ T_b_c = T_a_c``."""
        rotated = matmul(self.rotation.rotation_matrix, other.translation)
        return SE3(self.rotation.compose(other.rotation), self.translation + rotated)

    @checked
    def retract(self, delta: Float[Array, "6"]) -> "SE3":
        """``T @ exp(delta)``."""
        return self.compose(SE3.exp(delta))

    def inverse(self) -> "SE3":
        """The inverse."""
        rotation = self.rotation.inverse()
        return SE3(rotation, -matmul(rotation.rotation_matrix, self.translation))

    def matrix(self) -> Float[Array, "4 4"]:
        """Homogeneous matrix."""
        top = jnp.concatenate([self.rotation.rotation_matrix, self.translation[:, None]], axis=1)
        return jnp.concatenate([top, jnp.array([[0, 0, 0, 1]], top.dtype)])

    def adjoint(self) -> Float[Array, "6 6"]:
        """The matrix with ``T @ exp(d) == exp(adjoint @ d) @ T``."""
        rotation = self.rotation.rotation_matrix
        return _block_triangular(rotation, matmul(skew(self.translation), rotation))

    @checked
    def apply(self, points: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
        """Points of the inner frame in the outer frame."""
        return self.rotation.apply(points) + self.translation[None, :]

    def normalize(self) -> "SE3":
        """The pose with its rotation orthonormalized."""
        return SE3(self.rotation.normalize(), self.translation)


def _block_triangular(diagonal: Float[Array, "3 3"], corner: Float[Array, "3 3"]) -> Float[Array, "6 6"]:
    return jnp.block([[diagonal, corner], [jnp.zeros_like(diagonal), diagonal]])


def _translation_coupling(xi: Float[Array, "6"]) -> Float[Array, "3 3"]:
    """Coupling of rotation and translation: the upper right block of the left Jacobian.

    References:
        Barfoot and Furgale, "Associating uncertainty with three-dimensional poses", T-RO 2014, eq. 102.
    """
    v, w = skew(xi[:3]), skew(xi[3:])
    s = jnp.sum(xi[3:] ** 2)
    wv, vw, ww = matmul(w, v), matmul(v, w), matmul(w, w)
    wvw = matmul(wv, w)
    return (
        0.5 * v
        + series.third(s) * (wv + vw + wvw)
        + series.fourth(s) * (matmul(ww, v) + matmul(v, ww) - 3.0 * wvw)
        + series.fifth(s) * (matmul(wvw, w) + matmul(w, wvw))
    )
