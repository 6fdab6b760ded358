"""Interface of matrix Lie groups: rotations and poses."""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float


def as_floats(*values: Any) -> list[Array]:
    """The values as arrays of one floating-point dtype: that of the arrays among them, else the default."""
    dtype = jnp.result_type(*values, 1.0)
    return [jnp.asarray(value, dtype) for value in values]


def skew(v: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """The cross-product matrix: ``skew(a) @ b == cross(a, b)``."""
    x, y, z = v[0], v[1], v[2]
    o = jnp.zeros_like(x)
    return jnp.stack([jnp.stack([o, -z, y]), jnp.stack([z, o, -x]), jnp.stack([-y, x, o])])


class Group(eqx.Module):
    """A transformation ``T_a_b`` that maps coordinates of frame b to frame a.

    Tangents are ordered (translation, rotation) and perturb on the right: ``T @ exp(d)``. Stacks of poses are the same
    records with leading axes on their arrays; methods act on one pose and are batched by ``jax.vmap``.
    """

    dof: eqx.AbstractClassVar[int]
    labels: eqx.AbstractClassVar[tuple[str, ...]]

    @property
    @abstractmethod
    def batch_shape(self) -> tuple[int, ...]:
        """Leading axes of a stack; empty for one pose."""

    @abstractmethod
    def compose(self, other: Any) -> Any:
        """The product ``T_a_b @ T_b_c = T_a_c``."""

    @abstractmethod
    def inverse(self) -> Any:
        """The inverse ``T_b_a``."""

    @abstractmethod
    def log(self) -> Array:
        """The tangent whose exponential this is."""

    @abstractmethod
    def matrix(self) -> Array:
        """The homogeneous (poses) or rotation matrix."""

    @abstractmethod
    def adjoint(self) -> Array:
        """The matrix with ``T @ exp(d) == exp(adjoint @ d) @ T``."""

    @abstractmethod
    def apply(self, points: Array) -> Array:
        """Points "n k" of frame b in frame a."""

    @abstractmethod
    def retract(self, delta: Array) -> Any:
        """The pose ``T @ exp(delta)``."""

    def local(self, other: Any) -> Array:
        """The tangent that retracts this pose to the other: ``log(T^-1 @ other)``."""
        return self.inverse().compose(other).log()

    def __matmul__(self, other: Any) -> Any:
        return self.compose(other)
