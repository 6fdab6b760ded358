"""Ceiling brightness sensor: one pixel of an upward camera, with a ceiling mosaic as map."""

import math
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxloc._arguments import checked
from jaxloc.beliefs import Sensor
from jaxloc.beliefs.models import innovation
from jaxloc.images.interpolation import Sampled, sample
from jaxloc.poses import SE2

_OUTSIDE = -20.0  # log density outside the mosaic: small, but no weight is zero


class CeilingMosaic(eqx.Module):
    """A mosaic image of a ceiling, in floor coordinates.

    Args:
        brightness: "rows columns" in [0, 1]; columns grow with x, rows with y.
        resolution: edge of a pixel, m.
        origin: position of the center of pixel (0, 0), m.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> mosaic = jl.sensors.CeilingMosaic(jnp.array([[0.0, 1.0], [0.0, 1.0]]), 0.5, jnp.zeros(2))
        >>> mosaic.at(jnp.array([[0.25, 0.1]])).values.tolist()
        [0.5]
    """

    brightness: Float[Array, "rows columns"]
    resolution: Float[Array, ""]
    origin: Float[Array, "2"]

    def __init__(self, brightness: Float[Array, "rows columns"], resolution: Any, origin: Float[Array, "2"]):
        self.brightness = brightness
        self.resolution = jnp.asarray(resolution, brightness.dtype)
        self.origin = origin

    @property
    def upper(self) -> Float[Array, "2"]:
        """The corner opposite to the origin, m."""
        rows, columns = self.brightness.shape
        return self.origin + self.resolution * jnp.array([columns - 1, rows - 1], self.origin.dtype)

    @checked
    def at(self, points: Float[Array, "n 2"]) -> Sampled:
        """Brightness above points of the floor (m), bilinear; zero outside the mosaic."""
        return sample(self.brightness, (points - self.origin[None, :]) / self.resolution)


class CeilingSensor(Sensor):
    """Brightness of the ceiling vertically above the robot: ``p(z | x) = (1 - e) N(z; mosaic(x), sigma^2) + e``.

    Each reading is one number; only a sequence of readings determines the pose. The uniform part (over brightness from
    0 to 1) accounts for lamps that are off and occlusions.

    Args:
        mosaic: of the ceiling.
        standard_deviation: of the brightness, from noise of the pixel and errors of the mosaic.
        outlier: probability e of readings that the mosaic does not explain.
        mount: position of the camera on the robot, m.

    References:
        Dellaert, Burgard, Fox, Thrun, "Using the condensation algorithm for robust, vision-based mobile robot
        localization", CVPR 1999, section 4; review section 3.2 [R-12].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> mosaic = jl.sensors.CeilingMosaic(jnp.array([[0.0, 1.0], [0.0, 1.0]]), 1.0, jnp.zeros(2))
        >>> sensor = jl.sensors.CeilingSensor(mosaic, 0.1)
        >>> bright, valid = jnp.array(0.9), jnp.array(True)
        >>> here, there = jl.poses.SE2(0.9, 0.5, 0.0), jl.poses.SE2(0.1, 0.5, 0.0)
        >>> bool(sensor.log_prob(here, bright, valid) > sensor.log_prob(there, bright, valid))
        True
    """

    mosaic: CeilingMosaic
    standard_deviation: Float[Array, ""]
    outlier: Float[Array, ""]
    mount: Float[Array, "2"]

    def __init__(
        self,
        mosaic: CeilingMosaic,
        standard_deviation: Any,
        *,
        outlier: Any = 0.02,
        mount: Float[Array, "2"] | None = None,
    ):
        dtype = mosaic.brightness.dtype
        self.mosaic = mosaic
        self.standard_deviation = jnp.asarray(standard_deviation, dtype)
        self.outlier = jnp.asarray(outlier, dtype)
        self.mount = jnp.zeros(2, dtype) if mount is None else mount

    @checked
    def expect(self, state: SE2, measurement: Float[Array, ""]) -> Float[Array, ""]:
        """Brightness of the mosaic above the camera."""
        return self._sample(state).values[0]

    @checked
    def covariance(self, state: SE2, measurement: Float[Array, ""]) -> Float[Array, "1 1"]:
        """Variance of readings that are not outliers."""
        return (self.standard_deviation**2)[None, None]

    @checked
    def log_prob(self, state: SE2, measurement: Float[Array, ""], valid: Bool[Array, "*m"]) -> Float[Array, ""]:
        """Log density of a reading; outside the mosaic a low constant, so that particles there lose their weight."""
        seen = self._sample(state)
        residual, mask = innovation(seen.values[0], measurement, valid)
        sigma = self.standard_deviation
        normal = -0.5 * (residual[0] / sigma) ** 2 - jnp.log(sigma) - 0.5 * math.log(2.0 * math.pi)
        tiny = float(jnp.finfo(sigma.dtype).tiny)
        explained = normal + jnp.log(jnp.maximum(1.0 - self.outlier, tiny))
        density = jnp.logaddexp(explained, jnp.log(jnp.maximum(self.outlier, tiny)))
        return jnp.where(mask[0], jnp.where(seen.inside[0], density, _OUTSIDE), 0.0)

    def _sample(self, state: SE2) -> Sampled:
        return self.mosaic.at(state.apply(self.mount[None, :]))
