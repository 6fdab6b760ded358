"""Directions in space: points of the unit sphere, with two degrees of freedom."""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxloc._arguments import checked
from jaxloc._linalg import matmul
from jaxloc.poses import series
from jaxloc.poses.lie_group import as_floats

# Coefficients of asin(x) / x in x^2.
_ARCSINE = (1.0, 1 / 6, 3 / 40, 15 / 336, 105 / 3456, 945 / 42240, 10395 / 599040)
_SWITCH = 1e-2


class Direction(eqx.Module):
    """A unit vector on the sphere: a bearing, a plane normal, or a translation of unknown length.

    Retraction is along great circles: ``retract(d) = cos|d| v + sin|d| / |d| B d`` with the orthonormal tangents B of
    `basis`.

    Attributes:
        vector: "3", of length one.

    References:
        Absil, Mahony, Sepulchre, "Optimization algorithms on matrix manifolds", 2008, example 5.4.1.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> ahead = jl.poses.Direction.from_vector(jnp.array([0.0, 0.0, 2.0]))
        >>> ahead.retract(jnp.array([jnp.pi / 2, 0.0])).vector.round(3).tolist()
        [1.0, 0.0, 0.0]
    """

    vector: Float[Array, "*batch 3"]

    dof: ClassVar[int] = 2
    labels: ClassVar[tuple[str, ...]] = ("first tangent", "second tangent")

    @staticmethod
    def from_vector(vector: Any) -> "Direction":
        """Direction of a vector of any length; the z axis for zero or non-finite vectors."""
        (vector,) = as_floats(vector)
        largest = jnp.max(jnp.abs(vector))
        good = jnp.isfinite(largest) & (largest > 0)
        safe = jnp.where(good, vector, jnp.array([0.0, 0.0, 1.0], vector.dtype))
        safe = safe / lax.stop_gradient(jnp.max(jnp.abs(safe)))  # the direction does not depend on the scale
        return Direction(safe / jnp.sqrt(jnp.sum(safe * safe)))

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Leading axes of a stack."""
        return self.vector.shape[:-1]

    def basis(self) -> Float[Array, "3 2"]:
        """Two orthonormal tangents as columns, right-handed with the vector.

        References:
            Duff, Burgess, Christensen, Hery, Kensler, Liani, Villemin, "Building an orthonormal basis, revisited",
            JCGT 2017.
        """
        x, y, z = self.vector
        sign = jnp.where(z < 0, -1.0, 1.0).astype(z.dtype)
        a = -1.0 / (sign + z)
        b = x * y * a
        first = jnp.stack([1.0 + sign * x * x * a, sign * b, -sign * x])
        return jnp.stack([first, jnp.stack([b, sign + y * y * a, -y])], axis=1)

    @checked
    def retract(self, delta: Float[Array, "2"]) -> "Direction":
        """The direction turned along a great circle by ``|delta|`` rad."""
        squared = jnp.sum(delta * delta)
        turned = (1.0 - squared * series.versine(squared)) * self.vector
        turned = turned + series.sinc(squared) * matmul(self.basis(), delta)
        # One Newton step keeps the length at one over any number of retractions.
        return Direction(turned * (1.5 - 0.5 * jnp.sum(turned * turned)))

    @checked
    def local(self, other: "Direction") -> Float[Array, "2"]:
        """The tangent from this direction to the other; for the opposite one, half a turn along the first tangent."""
        side, along = matmul(self.basis().T, other.vector), jnp.sum(self.vector * other.vector)
        squared = jnp.sum(side * side)
        near = (squared < _SWITCH) & (along > 0)
        small = jnp.where(near, squared, 0.0)
        factor = jnp.full_like(small, _ARCSINE[-1])
        for coefficient in reversed(_ARCSINE[:-1]):
            factor = factor * small + coefficient
        opposite = squared == 0
        sine = jnp.sqrt(jnp.where(near | opposite, 1.0, squared))
        angle = jnp.arctan2(sine, jnp.where(near, 1.0, along))
        tangent = jnp.where(near, factor, angle / sine) * side
        half_turn = jnp.array([jnp.pi, 0.0], side.dtype)
        return jnp.where(opposite & ~near, half_turn, tangent)
