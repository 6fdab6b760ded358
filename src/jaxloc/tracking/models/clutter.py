"""Clutter models: Poisson processes of false measurements."""

import math
from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxloc.poses.lie_group import as_floats
from jaxloc.sensors import StereoRig


class Clutter(eqx.Module):
    """A Poisson process of false measurements.

    Attributes:
        rate: expected number of them in a scan.
    """

    rate: eqx.AbstractVar[Float[Array, ""]]

    @abstractmethod
    def log_density(self, measurement: Any) -> Float[Array, ""]:
        """Log density of a false measurement, with respect to volume in the tangent space of the measurement."""

    def log_intensity(self, measurement: Any) -> Float[Array, ""]:
        """``log kappa(z)``."""
        return log_rate(self.rate) + self.log_density(measurement)


def log_rate(rate: Float[Array, ""]) -> Float[Array, ""]:
    """Logarithm of a rate, with a finite derivative at zero, where it is minus infinity.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> float(log_rate(jnp.array(0.0))), float(jax.grad(log_rate)(0.0))
        (-inf, 0.0)
    """
    none = rate == 0.0
    return jnp.where(none, -jnp.inf, jnp.log(jnp.where(none, 1.0, rate)))


class UniformClutter(Clutter):
    """Clutter uniform over the measurement space.

    Args:
        rate: expected number in a scan.
        volume: of the measurement space, in its units.

    References:
        Vo and Ma 2006, section IV [T-77].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> clutter = jl.tracking.UniformClutter(rate=60.0, volume=4e6)
        >>> round(float(jnp.exp(clutter.log_intensity(jnp.zeros(2)))), 8)
        1.5e-05
    """

    rate: Float[Array, ""]
    volume: Float[Array, ""]

    def __init__(self, rate: Any, volume: Any):
        self.rate, self.volume = as_floats(rate, volume)

    def log_density(self, measurement: Any) -> Float[Array, ""]:
        """``- log V``."""
        del measurement
        return -jnp.log(self.volume)


class FrustumClutter(Clutter):
    """Clutter of a stereo camera: false matches uniform in (u_left, u_right, v), as points in space.

    A point triangulated from a false match has the density ``|dh/dp| / V`` at p, with h the projection
    by the rig: high near the cameras and low far away, where a pixel is a large volume.

    Args:
        rate: expected number in a scan.
        rig: the cameras; measurements are points in the left one's frame, m.
        width: of the images, px.
        height: of the images, px.
        nearest: least depth of matches, m; it bounds the disparity.

    References:
        T-77; the density is the change of variables of T-22.
    """

    rate: Float[Array, ""]
    rig: StereoRig
    width: Float[Array, ""]
    height: Float[Array, ""]
    nearest: Float[Array, ""]

    def __init__(self, rate: Any, rig: StereoRig, width: Any, height: Any, nearest: Any):
        self.rig = rig
        self.rate, self.width, self.height, self.nearest = as_floats(rate, width, height, nearest)

    def log_density(self, measurement: Float[Array, "3"]) -> Float[Array, ""]:
        """The Jacobian of the projection over the volume of possible matches."""
        depth = measurement[2]
        seen = depth > 0.5 * self.nearest
        point = jnp.where(seen, measurement, jnp.zeros(3, measurement.dtype).at[2].set(self.nearest))
        jacobian = jax.jacfwd(lambda p: self.rig.project(p[None])[0])(point)
        largest = self.rig.camera.fx * self.rig.baseline / self.nearest
        volume = self.width * self.height * largest
        return jnp.where(seen, jnp.log(jnp.abs(jnp.linalg.det(jacobian))) - jnp.log(volume), -math.inf)
