"""View-invariant attributes of features, and distances between them [K-55].

Kelly's list: an identity such as a barcode, a block of pixels, the eigenvalues of a corner, a curvature.

References:
    A. Kelly, *Mobile Robotics*, lecture 9.2.3.3.
"""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxloc._linalg import matmul


class Attribute(eqx.Module):
    """View-invariant attribute, one a feature."""

    @abstractmethod
    def squared_distance(self, other: Any) -> Float[Array, "n m"]:
        """Squared distances in sigmas to the attributes of other features; infinite for incompatible ones."""


class Identity(Attribute):
    """An identity that is read, as of a barcode or a radio tag; negative where unread, which matches anything.

    Attributes:
        codes: one a feature.
    """

    codes: Int[Array, " n"]

    def squared_distance(self, other: "Identity") -> Float[Array, "n m"]:
        """Zero for the same code or an unread one, infinite for another."""
        a, b = self.codes[:, None], other.codes[None, :]
        return jnp.where((a == b) | (a < 0) | (b < 0), 0.0, jnp.inf)


class Blocks(Attribute):
    """Blocks of pixels, or any descriptors, compared by normalized correlation.

    Attributes:
        values: "n d", gray levels or descriptor entries.
        sigma: of ``1 - correlation`` between views of one feature.
    """

    values: Float[Array, "n d"]
    sigma: float = 0.15

    def squared_distance(self, other: "Blocks") -> Float[Array, "n m"]:
        """``((1 - correlation) / sigma)^2``."""
        correlation = matmul(_standardized(self.values), _standardized(other.values).T)
        return ((1.0 - correlation) / self.sigma) ** 2


class CornerStrength(Attribute):
    """Eigenvalues of the structure tensor, compared by logarithms to reduce the effect of exposure.

    Attributes:
        eigenvalues: "n 2", positive, in one order.
        sigma: standard deviation of a logarithm.
    """

    eigenvalues: Float[Array, "n 2"]
    sigma: float = 0.3

    def squared_distance(self, other: "CornerStrength") -> Float[Array, "n m"]:
        """Squared difference of logarithms."""
        logs = [jnp.log(jnp.maximum(side.eigenvalues, 1e-20)) / self.sigma for side in (self, other)]
        return jnp.sum((logs[0][:, None, :] - logs[1][None, :, :]) ** 2, axis=2)


class Curvature(Attribute):
    """Curvature of the outline or of the range image.

    Attributes:
        values: 1/m.
        sigma: standard deviation, 1/m.
    """

    values: Float[Array, " n"]
    sigma: float = 1.0

    def squared_distance(self, other: "Curvature") -> Float[Array, "n m"]:
        """Squared difference."""
        return ((self.values[:, None] - other.values[None, :]) / self.sigma) ** 2


def _standardized(values: Float[Array, "n d"]) -> Float[Array, "n d"]:
    """Rows of zero mean and unit length; zero for flat ones."""
    finite = jnp.all(jnp.isfinite(values), axis=1, keepdims=True)
    safe = jnp.where(finite, values, 0.0)
    centered = safe - jnp.mean(safe, axis=1, keepdims=True)
    squared = jnp.sum(centered**2, axis=1, keepdims=True)
    some = squared > 1e-12 * jnp.sum(safe**2, axis=1, keepdims=True)
    return jnp.where(some, centered / jnp.sqrt(jnp.where(some, squared, 1.0)), 0.0)
