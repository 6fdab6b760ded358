"""Robust kernels (M-estimators): Huber, Cauchy, Geman-McClure, Tukey and Barron.

A kernel is a pair of functions of the squared whitened residual ``s = r^2``: the cost ``rho(s)`` and the weight
``rho'(r) / r`` of iteratively reweighted least squares (IRLS). Scales are in standard deviations, since residuals
are whitened.

References:
    Barron, "A general and adaptive robust loss function", CVPR 2019; Black and Rangarajan, IJCV 1996.
"""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxloc.poses.lie_group import as_floats

Squared = Float[Array, "*shape"]


class Loss(eqx.Module):
    """Interface of robust kernels."""

    @abstractmethod
    def rho(self, squared: Squared) -> Squared:
        """Cost of residuals with these squared norms; ``squared / 2`` near zero."""

    @abstractmethod
    def weight(self, squared: Squared) -> Squared:
        """``rho'(r) / r``: one near zero, falling for outliers."""

    @abstractmethod
    def widened(self, factor: Any) -> "Loss":
        """The kernel with its scale times a factor, for graduated non-convexity."""


class Quadratic(Loss):
    """Quadratic kernel: plain least squares."""

    def rho(self, squared: Squared) -> Squared:
        """Half the square."""
        return 0.5 * squared

    def weight(self, squared: Squared) -> Squared:
        """One."""
        return jnp.ones_like(squared)

    def widened(self, factor: Any) -> "Quadratic":
        """Itself."""
        del factor
        return self


class Huber(Loss):
    """Huber kernel: quadratic within the scale, linear beyond; convex."""

    scale: Float[Array, ""]

    def __init__(self, scale: Any = 1.345):
        (self.scale,) = as_floats(scale)

    def rho(self, squared: Squared) -> Squared:
        """Cost."""
        inside = squared <= self.scale**2
        norm = jnp.sqrt(jnp.where(inside, 1.0, squared))
        return jnp.where(inside, 0.5 * squared, self.scale * (norm - 0.5 * self.scale))

    def weight(self, squared: Squared) -> Squared:
        """One within the scale, ``scale / r`` beyond."""
        inside = squared <= self.scale**2
        return jnp.where(inside, 1.0, self.scale / jnp.sqrt(jnp.where(inside, 1.0, squared)))

    def widened(self, factor: Any) -> "Huber":
        """A wider kernel."""
        return Huber(self.scale * factor)


class Cauchy(Loss):
    """Cauchy (Lorentzian) kernel: logarithmic growth."""

    scale: Float[Array, ""]

    def __init__(self, scale: Any = 2.385):
        (self.scale,) = as_floats(scale)

    def rho(self, squared: Squared) -> Squared:
        """Cost."""
        c2 = self.scale**2
        return 0.5 * c2 * jnp.log1p(squared / c2)

    def weight(self, squared: Squared) -> Squared:
        """``1 / (1 + (r / scale)^2)``."""
        return 1.0 / (1.0 + squared / self.scale**2)

    def widened(self, factor: Any) -> "Cauchy":
        """A wider kernel."""
        return Cauchy(self.scale * factor)


class GemanMcClure(Loss):
    """Geman-McClure kernel: bounded cost, so that far outliers have no influence.

    Groups of consistent outliers create local minima: from a distant initial value, use `solve_graduated`.
    """

    scale: Float[Array, ""]

    def __init__(self, scale: Any = 3.0):
        (self.scale,) = as_floats(scale)

    def rho(self, squared: Squared) -> Squared:
        """Cost."""
        return 0.5 * squared / (1.0 + squared / self.scale**2)

    def weight(self, squared: Squared) -> Squared:
        """``1 / (1 + (r / scale)^2)^2``."""
        return 1.0 / (1.0 + squared / self.scale**2) ** 2

    def widened(self, factor: Any) -> "GemanMcClure":
        """A wider kernel."""
        return GemanMcClure(self.scale * factor)


class Tukey(Loss):
    """Tukey's bisquare kernel: residuals beyond the scale have zero weight."""

    scale: Float[Array, ""]

    def __init__(self, scale: Any = 4.685):
        (self.scale,) = as_floats(scale)

    def _ratio(self, squared: Squared) -> Squared:
        return jnp.minimum(squared / self.scale**2, 1.0)

    def rho(self, squared: Squared) -> Squared:
        """Cost."""
        ratio = self._ratio(squared)
        # (1 - (1 - q)^3) / 6, without the cancellation of small q.
        return self.scale**2 / 6.0 * ratio * (3.0 - ratio * (3.0 - ratio))

    def weight(self, squared: Squared) -> Squared:
        """``(1 - (r / scale)^2)^2`` within the scale, zero beyond."""
        return (1.0 - self._ratio(squared)) ** 2

    def widened(self, factor: Any) -> "Tukey":
        """A wider kernel."""
        return Tukey(self.scale * factor)


class Barron(Loss):
    """Barron's general kernel: shape 2 is quadratic, 1 pseudo-Huber, 0 Cauchy, -2 Geman-McClure, to -inf Welsch.

    The shape may be learned: value and gradient are smooth through 0 and 2.
    """

    shape: Float[Array, ""]
    scale: Float[Array, ""]

    def __init__(self, shape: Any, scale: Any = 1.0):
        self.shape, self.scale = as_floats(shape, scale)

    def _parts(self, squared: Squared) -> tuple[Squared, Array]:
        # |shape - 2| bounded away from zero: the limit is quadratic, and this one is equal to it within rounding.
        gap = jnp.maximum(jnp.abs(self.shape - 2.0), 1e-4)
        return squared / self.scale**2 / gap, gap

    def rho(self, squared: Squared) -> Squared:
        """Cost."""
        ratio, gap = self._parts(squared)
        log = jnp.log1p(ratio)
        # ((1 + q)^(a/2) - 1) / a by its series where a is near the logarithm's zero.
        half = 0.5 * self.shape
        near = jnp.abs(self.shape) < 1e-3
        safe = jnp.where(near, 1.0, self.shape)
        power = jnp.where(near, 0.5 * log * (1.0 + 0.5 * half * log), jnp.expm1(0.5 * safe * log) / safe)
        return self.scale**2 * gap * power

    def weight(self, squared: Squared) -> Squared:
        """``(1 + (r / scale)^2 / |shape - 2|)^(shape / 2 - 1)``."""
        ratio, _ = self._parts(squared)
        return jnp.exp((0.5 * self.shape - 1.0) * jnp.log1p(ratio))

    def widened(self, factor: Any) -> "Barron":
        """A wider kernel."""
        return Barron(self.shape, self.scale * factor)
