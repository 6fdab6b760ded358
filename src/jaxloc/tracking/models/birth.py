"""Birth models: new targets at known places, or at unexplained measurements."""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxloc.beliefs import Gaussian, Mixture
from jaxloc.poses.lie_group import as_floats
from jaxloc.tracking.models.clutter import log_rate


class Birth(eqx.Module):
    """Interface of birth models; without births by default."""

    def mixture(self, example: Any) -> Mixture:
        """Intensity of births between two scans, added in the prediction; empty by default.

        Args:
            example: a state, for its structure.
        """
        return Mixture.empty(0, example)

    def log_intensity(self, measurement: Any) -> Float[Array, ""] | None:
        """Log intensity of first measurements of new targets; None for models without such births."""
        del measurement
        return None

    def seed(self, measurement: Any) -> Gaussian | None:
        """Density of a new target given its first measurement; None for models without such births."""
        del measurement
        return None


class StaticBirth(Birth):
    """Targets appear near known places, with a constant intensity.

    Args:
        intensity: their mixture; weights are expected numbers in a scan.

    References:
        Vo and Ma 2006, eq. 21 [T-75].
    """

    intensity: Mixture

    def __check_init__(self):
        if isinstance(self.intensity, Mixture):  # else a prefix tree, such as in_axes
            self.intensity.check()

    def mixture(self, example: Any) -> Mixture:
        """The same at every scan."""
        del example
        return self.intensity


class MeasuredBirth(Birth):
    """Measurement-driven births, uniform over the measurement space: targets are born with their first measurement.

    A new target is detected with certainty, so that its weight after a scan, relative to clutter and existing targets,
    is exact: ``b / (kappa(z) + b + sum ...)``.

    Args:
        rate: expected number of births in a scan.
        volume: of the measurement space.

    References:
        Beard, Vo, Vo and Arulampalam, "A partially uniform target birth model for Gaussian mixture PHD/CPHD filtering",
        IEEE TAES 2013; Ristic et al., "Adaptive target birth intensity", IEEE TAES 2012 [B.6].
    """

    rate: eqx.AbstractVar[Float[Array, ""]]
    volume: eqx.AbstractVar[Float[Array, ""]]

    def log_intensity(self, measurement: Any) -> Float[Array, ""]:
        """``log (rate / volume)``."""
        del measurement
        return log_rate(self.rate) - jnp.log(self.volume)

    @abstractmethod
    def seed(self, measurement: Any) -> Gaussian:
        """Density of a new target given its first measurement."""


class PointBirth(MeasuredBirth):
    """Measurement-driven births of states (position, other entries) whose position is measured.

    Args:
        rate: expected number of births in a scan.
        volume: of the measurement space, m^2 or m^3.
        noise_covariance: of a measured position.
        variances: of the other entries, such as velocities, whose mean is zero.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> birth = jl.tracking.PointBirth(0.1, 1e6, 100.0 * jnp.eye(2), jnp.array([25.0, 25.0]))
        >>> birth.seed(jnp.array([3.0, 4.0])).mean.tolist()
        [3.0, 4.0, 0.0, 0.0]
    """

    rate: Float[Array, ""]
    volume: Float[Array, ""]
    noise_covariance: Float[Array, "m m"]
    variances: Float[Array, " r"]

    def __init__(self, rate: Any, volume: Any, noise_covariance: Any, variances: Any):
        self.rate, self.volume = as_floats(rate, volume)
        self.noise_covariance, self.variances = noise_covariance, variances

    def seed(self, measurement: Float[Array, " m"]) -> Gaussian:
        """The measured position, with zero mean for the other entries."""
        mean = jnp.concatenate([measurement, jnp.zeros_like(self.variances)])
        return Gaussian(mean, jax.scipy.linalg.block_diag(self.noise_covariance, jnp.diag(self.variances)))
