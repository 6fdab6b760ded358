"""Interface of matrix Lie groups: rotations and poses."""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxloc._arguments import checked


def as_floats(*values: Any) -> list[Array]:
    """The values as arrays of one floating-point dtype: that of the arrays among them, else the default."""
    values = tuple(np.asarray(value) if isinstance(value, list | tuple) else value for value in values)
    dtype = jnp.result_type(*values, 1.0)
    return [jnp.asarray(value, dtype) for value in values]


@checked
def skew(v: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """The cross-product matrix: ``skew(a) @ b == cross(a, b)``."""
    x, y, z = v[0], v[1], v[2]
    o = jnp.zeros_like(x)
    return jnp.stack([jnp.stack([o, -z, y]), jnp.stack([z, o, -x]), jnp.stack([-y, x, o])])


def bounded(*parts: tuple[Array, float]) -> tuple[Bool[Array, ""], list[Array]]:
    """Arrays with which a map of a group can be computed, and whether they are finite.

    Filters notice non-finite numbers by those that come out: so `unless` puts them back, after a computation with
    finite ones, by which derivatives are zero in place of NaN. Finite numbers give finite results, however large.

    Args:
        *parts: each with the largest number that needs no care.

    Returns:
        Whether all are finite, and the arrays: themselves; clipped, without derivative, where one is larger; zero where
        one is not finite.
    """
    finite, small = jnp.array(True), jnp.array(True)
    for part, largest in parts:
        finite, small = finite & jnp.all(jnp.isfinite(part)), small & jnp.all(jnp.abs(part) <= largest)
    clipped = [lax.stop_gradient(jnp.where(finite, jnp.clip(part, -most, most), 0.0)) for part, most in parts]
    return finite, [jnp.where(small, part, other) for (part, _), other in zip(parts, clipped, strict=True)]


def unless(finite: Bool[Array, ""], result: Any) -> Any:
    """The result, or NaN, without derivatives, where its arguments were not finite."""
    return jax.tree.map(lambda leaf: jnp.where(finite, leaf, jnp.nan), result)


def largest_angle(dtype: Any) -> float:
    """The largest rotation that is computed with, rad: its square is finite with room to spare."""
    return 1e-3 * float(jnp.finfo(dtype).max) ** 0.5


def largest_length(dtype: Any) -> float:
    """The largest coordinate that is computed with: sums of some are finite."""
    return float(jnp.finfo(dtype).max) / 64.0


class Group(eqx.Module):
    """A transformation ``T_a_b`` that maps coordinates of frame b to frame a.

    Exponential, logarithm and interpolation of finite numbers are finite, up to the largest float; those of NaN and
    infinity are NaN, by which estimators notice them, with derivatives of zero.

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
