"""Warps of the image plane as matrix Lie groups: translation, Euclidean, similarity, affine, homography.

A warp W maps pixels of a template to pixels of an image, ``template(x) ~ image(W(x))``. Each class is a subgroup of
the next, and their generators are nested in one order, so that a tangent of a smaller group is the beginning of one of
a larger group: shift right (px), shift down (px), rotation (u towards v, rad), scale (log), stretch of u against v,
shear, and two perspective directions (1/px) [K-17, K-23].
"""

from abc import abstractmethod
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxloc._linalg import matmul
from jaxloc.poses import SE2
from jaxloc.poses.lie_group import Group
from jaxloc.poses.matrix_exponential import exponential_less_identity, logarithm

_LABELS = ("right", "down", "rotation", "scale", "stretch", "shear", "perspective right", "perspective down")
_FAR = -1e6  # coordinates of points at or beyond the horizon, outside every image, px


class Warp(Group):
    """A transformation of pixel coordinates (u right, v down) that can be composed, inverted and perturbed.

    Perturbations act first, in the template: ``W @ exp(d)``.
    """

    @staticmethod
    @abstractmethod
    def from_matrix(matrix: Float[Array, "3 3"]) -> Any:
        """The warp of a homogeneous matrix; components outside the group are dropped."""

    @classmethod
    def of(cls, warp: "Warp") -> Any:
        """The same warp as a member of this group; components outside the group are dropped.

        Example:
            >>> import jax.numpy as jnp
            >>> Affine.of(Translation(jnp.array([2.0, 1.0]))).matrix()[0].tolist()
            [1.0, 0.0, 2.0]
        """
        return cls.from_matrix(warp.matrix())

    @classmethod
    def identity(cls, dtype: Any = float) -> Any:
        """The identity."""
        return cls.from_matrix(jnp.eye(3, dtype=dtype))

    @classmethod
    def exp(cls, delta: Float[Array, " d"]) -> Any:
        """The warp of a tangent, by the exponential of a 3x3 matrix."""
        generator = tangent_matrix(delta)
        # Without its trace, the exponential has determinant one; a homography is defined up to scale.
        shift = jnp.trace(generator) / 3.0 if cls.dof == 8 else jnp.zeros((), delta.dtype)
        eye = jnp.eye(3, dtype=delta.dtype)
        return cls.from_matrix(eye + exponential_less_identity(generator - shift * eye))

    @classmethod
    def jacobian_components(
        cls, u: Float[Array, "*n"], v: Float[Array, "*n"]
    ) -> tuple[Float[Array, "d *n"], Float[Array, "d *n"]]:
        """Derivative of both coordinates of ``exp(d)`` applied to pixels, by d at d = 0, on component arrays [K-72]."""
        one, zero = jnp.ones_like(u), jnp.zeros_like(u)
        right = (one, zero, -v, u, u, v, -u * u, -u * v)
        down = (zero, one, u, v, -v, u, -u * v, -v * v)
        return jnp.stack(right[: cls.dof]), jnp.stack(down[: cls.dof])

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Leading axes of a stack."""
        return jax.tree.leaves(self)[0].shape[: -2 if self.dof > 2 else -1]

    def compose(self, other: Any) -> Any:
        """The warp that applies the other one first; a product of two groups is in the larger one."""
        larger = type(self) if self.dof >= other.dof else type(other)
        return larger.from_matrix(matmul(self.matrix(), other.matrix()))

    def retract(self, delta: Float[Array, " d"]) -> Any:
        """``W @ exp(delta)``: the compositional update."""
        return self.compose(self.exp(delta))

    def inverse(self) -> Any:
        """Inverse warp, from image to template; meaningless numbers for a singular warp.

        By the adjugate, scaled so that the last entry of translations, rotations and affine warps is exactly one.
        """
        (a, b, c), (d, e, f), (g, h, i) = self.matrix()
        rows = (
            (e * i - f * h, c * h - b * i, b * f - c * e),
            (f * g - d * i, a * i - c * g, c * d - a * f),
            (d * h - e * g, b * g - a * h, a * e - b * d),
        )
        adjugate = jnp.stack([jnp.stack(row) for row in rows])
        scale = a * rows[0][0] + b * rows[1][0] + c * rows[2][0]
        return self.from_matrix(adjugate / jnp.where(jnp.abs(scale) > 0, scale, 1.0))

    def log(self) -> Float[Array, " d"]:
        """Logarithm: the tangent whose exponential this is, for rotations of less than 180 degrees."""
        return _vee(logarithm(self.matrix()))[: self.dof]

    def adjoint(self) -> Float[Array, "d d"]:
        """The matrix with ``W @ exp(d) == exp(adjoint @ d) @ W``."""
        matrix, inverse = self.matrix(), self.inverse().matrix()
        unit = jnp.eye(self.dof, dtype=matrix.dtype)
        return jax.vmap(lambda d: _vee(matmul(matrix, matmul(tangent_matrix(d), inverse)))[: self.dof], out_axes=1)(
            unit
        )

    def map_components(
        self, u: Float[Array, "*n"], v: Float[Array, "*n"]
    ) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
        """Mapped pixels, on component arrays of any shape; points at or beyond the horizon are mapped far outside."""
        (a, b, c), (d, e, f), (g, h, i) = self.matrix()
        right, down = a * u + b * v + c, d * u + e * v + f
        if self.dof < 8:
            return right, down
        depth = g * u + h * v + i
        front = depth > 1e-6
        inverse = 1.0 / jnp.where(front, depth, 1.0)
        return jnp.where(front, right * inverse, _FAR), jnp.where(front, down * inverse, _FAR)

    def apply(self, points: Float[Array, "n 2"]) -> Float[Array, "n 2"]:
        """Image pixels of template pixels (right, down)."""
        return jnp.stack(self.map_components(points[:, 0], points[:, 1]), axis=-1)

    def add(self, delta: Float[Array, " d"]) -> Any:
        """The additive update: the tangent added to the entries of the matrix whose last entry is one."""
        matrix = self.matrix()
        corner = jnp.where(jnp.abs(matrix[2, 2]) > 1e-6, matrix[2, 2], 1.0)
        return self.from_matrix(matrix / corner + tangent_matrix(delta))

    def additive_jacobian_components(
        self, u: Float[Array, "*n"], v: Float[Array, "*n"]
    ) -> tuple[Float[Array, "d *n"], Float[Array, "d *n"]]:
        """Derivative of both coordinates of ``add(d)`` applied to pixels, by d at d = 0, on component arrays."""
        to_right, to_down = self.map_components(u, v)
        one, zero = jnp.ones_like(u), jnp.zeros_like(u)
        right = (one, zero, -v, u, u, v, -u * to_right, -v * to_right)
        down = (zero, one, u, v, -v, u, -u * to_down, -v * to_down)
        matrix = self.matrix()
        corner = jnp.where(jnp.abs(matrix[2, 2]) > 1e-6, matrix[2, 2], 1.0)
        depth = (matrix[2, 0] * u + matrix[2, 1] * v + matrix[2, 2]) / corner
        inverse = 1.0 / jnp.where(depth > 1e-6, depth, 1.0)
        count = self.dof
        return jnp.stack(right[:count]) * inverse[None], jnp.stack(down[:count]) * inverse[None]


class Translation(Warp):
    """Translation ``x + t`` [K-23].

    Attributes:
        translation: (right, down), px.

    Example:
        >>> import jax.numpy as jnp
        >>> Translation(jnp.array([2.0, -1.0])).apply(jnp.array([[5.0, 5.0]])).tolist()
        [[7.0, 4.0]]
    """

    translation: Float[Array, "2"]

    dof: ClassVar[int] = 2
    labels: ClassVar[tuple[str, ...]] = _LABELS[:2]

    @staticmethod
    def from_matrix(matrix: Float[Array, "3 3"]) -> "Translation":
        """The translation of a homogeneous matrix."""
        return Translation(matrix[:2, 2])

    @classmethod
    def exp(cls, delta: Float[Array, "2"]) -> "Translation":
        """The translation itself."""
        return Translation(delta)

    def log(self) -> Float[Array, "2"]:
        """The translation itself."""
        return self.translation

    def matrix(self) -> Float[Array, "3 3"]:
        """Homogeneous matrix."""
        return jnp.eye(3, dtype=self.translation.dtype).at[:2, 2].set(self.translation)


class Euclidean(Warp):
    """Rotation and translation: `poses.SE2` on pixels.

    Example:
        >>> import jax.numpy as jnp
        >>> quarter = Euclidean.exp(jnp.array([0.0, 0.0, jnp.pi / 2]))
        >>> [round(x, 3) + 0.0 for x in quarter.apply(jnp.array([[1.0, 0.0]]))[0].tolist()]
        [0.0, 1.0]
    """

    homogeneous: Float[Array, "3 3"]

    dof: ClassVar[int] = 3
    labels: ClassVar[tuple[str, ...]] = _LABELS[:3]

    @staticmethod
    def from_matrix(matrix: Float[Array, "3 3"]) -> "Euclidean":
        """The rotation nearest to a matrix, and its translation."""
        cos, sin = matrix[0, 0] + matrix[1, 1], matrix[1, 0] - matrix[0, 1]
        squared = cos * cos + sin * sin
        turns = squared > 0
        inverse = jnp.where(turns, 1.0 / jnp.sqrt(jnp.where(turns, squared, 1.0)), 0.0)
        cos, sin = jnp.where(turns, cos * inverse, 1.0), sin * inverse
        return Euclidean(_similar(cos, sin, matrix[:2, 2]))

    @classmethod
    def exp(cls, delta: Float[Array, "3"]) -> "Euclidean":
        """The motion of a constant twist."""
        return Euclidean(SE2.exp(delta).matrix())

    def log(self) -> Float[Array, "3"]:
        """The twist of the motion."""
        return SE2.from_matrix(self.homogeneous).log()

    def matrix(self) -> Float[Array, "3 3"]:
        """Homogeneous matrix."""
        return self.homogeneous

    def add(self, delta: Float[Array, "3"]) -> "Euclidean":
        """Sum of angles and translations."""
        turned = matmul(self.homogeneous, SE2.exp(delta.at[:2].set(0.0)).matrix())
        return Euclidean.from_matrix(turned.at[:2, 2].add(delta[:2]))

    def additive_jacobian_components(
        self, u: Float[Array, "*n"], v: Float[Array, "*n"]
    ) -> tuple[Float[Array, "3 *n"], Float[Array, "3 *n"]]:
        """Derivative by translation and angle."""
        one, zero = jnp.ones_like(u), jnp.zeros_like(u)
        (a, b, _), (d, e, _), _ = self.homogeneous
        return jnp.stack([one, zero, -a * v + b * u]), jnp.stack([zero, one, -d * v + e * u])


class Similarity(Warp):
    """Rotation, scale and translation."""

    homogeneous: Float[Array, "3 3"]

    dof: ClassVar[int] = 4
    labels: ClassVar[tuple[str, ...]] = _LABELS[:4]

    @staticmethod
    def from_matrix(matrix: Float[Array, "3 3"]) -> "Similarity":
        """The scaled rotation nearest to a matrix, and its translation."""
        cos, sin = 0.5 * (matrix[0, 0] + matrix[1, 1]), 0.5 * (matrix[1, 0] - matrix[0, 1])
        return Similarity(_similar(cos, sin, matrix[:2, 2]))

    def matrix(self) -> Float[Array, "3 3"]:
        """Homogeneous matrix."""
        return self.homogeneous


class Affine(Warp):
    """Linear map and translation; parallel lines stay parallel."""

    homogeneous: Float[Array, "3 3"]

    dof: ClassVar[int] = 6
    labels: ClassVar[tuple[str, ...]] = _LABELS[:6]

    @staticmethod
    def from_matrix(matrix: Float[Array, "3 3"]) -> "Affine":
        """The affine part of a matrix."""
        last = jnp.zeros((1, 3), matrix.dtype).at[0, 2].set(1.0)
        return Affine(jnp.concatenate([matrix[:2], last]))

    def matrix(self) -> Float[Array, "3 3"]:
        """Homogeneous matrix."""
        return self.homogeneous


class Homography(Warp):
    """Homography, the map between two images of a plane; SL(3), determinant one.

    References:
        Benhimane and Malis, "Homography-based 2D visual tracking and servoing", 2007, for the group.

    Example:
        >>> import jax.numpy as jnp
        >>> warp = Homography.exp(jnp.array([3.0, 0.0, 0.1, 0.0, 0.0, 0.0, 1e-3, 0.0]))
        >>> bool(jnp.allclose((warp @ warp.inverse()).matrix(), jnp.eye(3), atol=1e-5))
        True
    """

    homogeneous: Float[Array, "3 3"]

    dof: ClassVar[int] = 8
    labels: ClassVar[tuple[str, ...]] = _LABELS

    @staticmethod
    def from_matrix(matrix: Float[Array, "3 3"]) -> "Homography":
        """The homography of any multiple of its matrix; a singular one is unchanged."""
        determinant = jnp.sum(matrix[0] * jnp.cross(matrix[1], matrix[2]))
        regular = jnp.abs(determinant) > 0
        return Homography(matrix / jnp.where(regular, jnp.cbrt(jnp.where(regular, determinant, 1.0)), 1.0))

    def matrix(self) -> Float[Array, "3 3"]:
        """Matrix of determinant one."""
        return self.homogeneous


def _similar(cos: Float[Array, ""], sin: Float[Array, ""], shift: Float[Array, "2"]) -> Float[Array, "3 3"]:
    zero, one = jnp.zeros_like(cos), jnp.ones_like(cos)
    rows = ((cos, -sin, shift[0]), (sin, cos, shift[1]), (zero, zero, one))
    return jnp.stack([jnp.stack(row) for row in rows])


def tangent_matrix(delta: Float[Array, " d"]) -> Float[Array, "3 3"]:
    """The matrix of a tangent of any of the groups."""
    zero = jnp.zeros((), delta.dtype)
    right, down, turn, scale, stretch, shear, p, q = [*delta, *[zero] * (8 - delta.shape[0])]
    rows = ((scale + stretch, shear - turn, right), (shear + turn, scale - stretch, down), (p, q, zero))
    return jnp.stack([jnp.stack(row) for row in rows])


def _vee(matrix: Float[Array, "3 3"]) -> Float[Array, "8"]:
    """The tangent of a matrix, up to a multiple of the identity."""
    (a, b, right), (c, d, down), (p, q, corner) = matrix
    tangent = (right, down, 0.5 * (c - b), 0.5 * (a + d) - corner, 0.5 * (a - d), 0.5 * (b + c), p, q)
    return jnp.stack(tangent)
