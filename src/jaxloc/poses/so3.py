"""SO(3): rotations in space."""

from typing import Any, ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxloc._arguments import checked
from jaxloc._linalg import matmul
from jaxloc.poses import series
from jaxloc.poses.lie_group import Group, as_floats, bounded, largest_angle, skew, unless


class SO3(Group):
    """A rotation in space, stored as its matrix, so that rotating points is one matrix product.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> R = jl.poses.SO3.from_euler(yaw=0.3, pitch=-0.2, roll=0.1)
        >>> bool(jnp.allclose(jl.poses.SO3.exp(R.log()).matrix(), R.matrix(), atol=1e-6))
        True
    """

    rotation_matrix: Float[Array, "3 3"]

    dof: ClassVar[int] = 3
    labels: ClassVar[tuple[str, ...]] = ("rotation_x", "rotation_y", "rotation_z")

    @staticmethod
    def identity(dtype: Any = float) -> "SO3":
        """The identity."""
        return SO3(jnp.eye(3, dtype=dtype))

    @staticmethod
    @checked
    def from_matrix(matrix: Float[Array, "3 3"]) -> "SO3":
        """Rotation of an orthonormal matrix (not orthonormalized; see `normalize`)."""
        return SO3(matrix)

    @staticmethod
    @checked
    def from_quaternion(wxyz: Float[Array, "4"]) -> "SO3":
        """Rotation of a quaternion (scalar first), which is normalized; zero gives the identity."""
        norm_squared = jnp.sum(wxyz**2)
        good = norm_squared > 0
        one = jnp.zeros_like(wxyz).at[0].set(1.0)
        q = jnp.where(good, wxyz, one) / jnp.sqrt(jnp.where(good, norm_squared, 1.0))
        w, v = q[0], q[1:]
        cross = skew(v)
        return SO3(jnp.eye(3, dtype=q.dtype) + 2.0 * w * cross + 2.0 * matmul(cross, cross))

    @staticmethod
    def from_euler(yaw: Any, pitch: Any, roll: Any) -> "SO3":
        """``Rz(yaw) @ Ry(pitch) @ Rx(roll)``, rad [K-7]."""
        yaw, pitch, roll = as_floats(yaw, pitch, roll)
        cy, sy, cp, sp, cr, sr = (f(a) for a in (yaw, pitch, roll) for f in (jnp.cos, jnp.sin))
        rows = (
            (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
            (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
            (-sp, cp * sr, cp * cr),
        )
        return SO3(jnp.stack([jnp.stack(row) for row in rows]))

    @staticmethod
    @checked
    def exp(xi: Float[Array, "3"]) -> "SO3":
        """Rotation about ``xi`` by its length (Rodrigues), rad."""
        finite, (xi,) = bounded((xi, largest_angle(xi.dtype)))
        s = jnp.sum(xi**2)
        cross = skew(xi)
        eye = jnp.eye(3, dtype=xi.dtype)
        return unless(finite, SO3(eye + series.sinc(s) * cross + series.versine(s) * matmul(cross, cross)))

    @staticmethod
    @checked
    def left_jacobian(xi: Float[Array, "3"]) -> Float[Array, "3 3"]:
        """``J`` with ``exp(xi + d) ~ exp(J d) @ exp(xi)``; the right one is ``left_jacobian(-xi)``."""
        s = jnp.sum(xi**2)
        cross = skew(xi)
        return jnp.eye(3, dtype=xi.dtype) + series.versine(s) * cross + series.third(s) * matmul(cross, cross)

    @staticmethod
    @checked
    def left_jacobian_inverse(xi: Float[Array, "3"]) -> Float[Array, "3 3"]:
        """Inverse of `left_jacobian`, for angles below 2 pi."""
        s = jnp.sum(xi**2)
        cross = skew(xi)
        return jnp.eye(3, dtype=xi.dtype) - 0.5 * cross + series.cotangent(s) * matmul(cross, cross)

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Leading axes of a stack."""
        return self.rotation_matrix.shape[:-2]

    def quaternion(self) -> Float[Array, "4"]:
        """Unit quaternion (w, x, y, z) with ``w >= 0``, by the largest of the four pivots (Shepperd 1978)."""
        m = self.rotation_matrix
        a, b, c = m[0, 0], m[1, 1], m[2, 2]
        x, y, z = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
        xy, xz, yz = m[0, 1] + m[1, 0], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1]
        pivots = jnp.stack([1.0 + a + b + c, 1.0 + a - b - c, 1.0 - a + b - c, 1.0 - a - b + c])
        rows = jnp.stack(
            [
                jnp.stack([pivots[0], x, y, z]),
                jnp.stack([x, pivots[1], xy, xz]),
                jnp.stack([y, xy, pivots[2], yz]),
                jnp.stack([z, xz, yz, pivots[3]]),
            ]
        )
        best = jnp.argmax(pivots)
        q = rows[best] * (0.5 / jnp.sqrt(jnp.maximum(pivots[best], 0.5)))
        return jnp.where(q[0] < 0, -q, q)

    def log(self) -> Float[Array, "3"]:
        """Rotation vector of length at most pi; finite with its derivatives at zero and at pi."""
        # No entry of a rotation is above one.
        finite, (matrix,) = bounded((self.rotation_matrix, 4.0))
        q = SO3(matrix).quaternion()
        w, v = q[0], q[1:]
        n2 = jnp.sum(v**2)
        small = n2 < 1e-2
        # atan(t) / t by its series in t^2 where t = |v| / w is small: no square root of zero is differentiated.
        t2 = jnp.where(small, n2 / jnp.where(small, w, 1.0) ** 2, 0.0)
        near = sum((-t2) ** k / (2 * k + 1) for k in range(9)) / jnp.where(small, w, 1.0)
        n = jnp.sqrt(jnp.where(small, 1.0, n2))
        far = jnp.arctan2(n, w) / n
        return unless(finite, 2.0 * jnp.where(small, near, far) * v)

    def euler(self) -> Float[Array, "3"]:
        """(yaw, pitch, roll) of ``Rz Ry Rx``, rad; at pitch +-90 degrees yaw is 0 and roll takes all [K-7]."""
        m = self.rotation_matrix
        horizontal = m[0, 0] ** 2 + m[1, 0] ** 2
        # Beyond this the first column holds only rounding noise.
        locked = horizontal < 10.0 * jnp.finfo(m.dtype).eps ** 2
        horizontal = jnp.sqrt(jnp.where(locked, 1.0, horizontal))
        pitch = jnp.where(locked, -jnp.sign(m[2, 0]) * (jnp.pi / 2), jnp.arctan2(-m[2, 0], horizontal))
        free = jnp.where(locked, 1.0, m[0, 0]), jnp.where(locked, 0.0, m[1, 0])
        yaw = jnp.arctan2(free[1], free[0])
        roll_sin = jnp.where(locked, -m[1, 2], m[2, 1])
        roll_cos = jnp.where(locked, m[1, 1], m[2, 2])
        return jnp.stack([yaw, pitch, jnp.arctan2(roll_sin, roll_cos)])

    @checked
    def compose(self, other: "SO3") -> "SO3":
        """The product of both rotations."""
        return SO3(matmul(self.rotation_matrix, other.rotation_matrix))

    @checked
    def retract(self, delta: Float[Array, "3"]) -> "SO3":
        """``R @ exp(delta)``."""
        return self.compose(SO3.exp(delta))

    def inverse(self) -> "SO3":
        """The inverse."""
        return SO3(self.rotation_matrix.T)

    def matrix(self) -> Float[Array, "3 3"]:
        """Rotation matrix."""
        return self.rotation_matrix

    def adjoint(self) -> Float[Array, "3 3"]:
        """The rotation matrix itself."""
        return self.rotation_matrix

    @checked
    def apply(self, points: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
        """Rotated points."""
        return matmul(points, self.rotation_matrix.T)

    def normalize(self) -> "SO3":
        """The rotation orthonormalized by one Newton step, which removes accumulated rounding."""
        m = self.rotation_matrix
        return SO3(1.5 * m - 0.5 * matmul(m, matmul(m.T, m)))
