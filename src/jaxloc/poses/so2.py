"""SO(2): rotations in the plane."""

from typing import Any, ClassVar

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxloc._arguments import checked
from jaxloc._linalg import matmul
from jaxloc.poses.lie_group import Group, as_floats


class SO2(Group):
    """A planar rotation, stored as cosine and sine of its counter-clockwise angle.

    Make one from an angle by ``SO2.from_angle(angle)`` (rad): ``SO2(angle)`` fails, since the constructor takes the
    cosine and the sine. `angle` returns the angle.

    Attributes:
        cos: cosine of the angle.
        sin: sine of the angle.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> quarter = jl.poses.SO2.from_angle(jnp.pi / 2)
        >>> quarter.apply(jnp.array([[1.0, 0.0]])).round(3).tolist()
        [[-0.0, 1.0]]
    """

    cos: Float[Array, ""]
    sin: Float[Array, ""]

    dof: ClassVar[int] = 1
    labels: ClassVar[tuple[str, ...]] = ("rotation",)

    @staticmethod
    def from_angle(angle: Any) -> "SO2":
        """Rotation by an angle, rad, counter-clockwise."""
        (angle,) = as_floats(angle)
        finite = jnp.isfinite(angle)
        safe = jnp.where(finite, angle, 0.0)
        return SO2(jnp.where(finite, jnp.cos(safe), jnp.nan), jnp.where(finite, jnp.sin(safe), jnp.nan))

    @staticmethod
    def identity(dtype: Any = float) -> "SO2":
        """The identity."""
        return SO2(jnp.ones((), dtype), jnp.zeros((), dtype))

    @staticmethod
    @checked
    def exp(xi: Float[Array, "1"]) -> "SO2":
        """Rotation of a tangent (rad)."""
        return SO2.from_angle(xi[0])

    @staticmethod
    @checked
    def left_jacobian(xi: Float[Array, "1"]) -> Float[Array, "1 1"]:
        """One, since planar rotations commute."""
        return jnp.ones((1, 1), xi.dtype)

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Leading axes of a stack."""
        return self.cos.shape

    def angle(self) -> Float[Array, ""]:
        """Angle in (-pi, pi]."""
        finite, small = (test(self.sin) & test(self.cos) for test in (jnp.isfinite, lambda x: jnp.abs(x) <= 4.0))
        # The squares in its derivative overflow for larger numbers, which are no cosines.
        sin, cos = jnp.where(small, self.sin, 0.0), jnp.where(small, self.cos, 1.0)
        other = lax.stop_gradient(jnp.arctan2(self.sin, self.cos))
        return jnp.where(small, jnp.arctan2(sin, cos), jnp.where(finite, other, jnp.nan))

    def log(self) -> Float[Array, "1"]:
        """Angle as a tangent."""
        return self.angle()[None]

    @checked
    def compose(self, other: "SO2") -> "SO2":
        """The product: rotation by the sum of both angles."""
        return SO2(self.cos * other.cos - self.sin * other.sin, self.sin * other.cos + self.cos * other.sin)

    @checked
    def retract(self, delta: Float[Array, "1"]) -> "SO2":
        """The rotation perturbed by an angle delta."""
        return self.compose(SO2.exp(delta))

    def inverse(self) -> "SO2":
        """Rotation by the opposite angle."""
        return SO2(self.cos, -self.sin)

    def matrix(self) -> Float[Array, "2 2"]:
        """Rotation matrix."""
        return jnp.stack([jnp.stack([self.cos, -self.sin]), jnp.stack([self.sin, self.cos])])

    def adjoint(self) -> Float[Array, "1 1"]:
        """One, since planar rotations commute."""
        return jnp.ones((1, 1), self.cos.dtype)

    @checked
    def apply(self, points: Float[Array, "n 2"]) -> Float[Array, "n 2"]:
        """Rotated points."""
        return matmul(points, self.matrix().T)

    def normalize(self) -> "SO2":
        """The rotation normalized, which removes accumulated rounding."""
        scale = 1.0 / jnp.sqrt(self.cos**2 + self.sin**2)
        return SO2(self.cos * scale, self.sin * scale)


@checked
def wrap_angle(angle: Float[Array, "..."]) -> Float[Array, "..."]:
    """Angles wrapped to [-pi, pi), rad; the derivative is one. NaN for those that are not finite, derivative zero."""
    finite = jnp.isfinite(angle)
    return jnp.where(finite, (jnp.where(finite, angle, 0.0) + jnp.pi) % (2 * jnp.pi) - jnp.pi, jnp.nan)
