"""Where targets appear: at known places, or wherever something is measured that nothing explains."""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxloc.beliefs import Gaussian, Mixture
from jaxloc.poses.lie_group import as_floats


class Birth(eqx.Module):
    """How new targets enter the belief."""

    def mixture(self, example: Any) -> Mixture:
        """Intensity of births between two scans, which enters with the prediction; nothing by default.

        Args:
            example: a state, for its structure.
        """
        return Mixture.empty(0, example)

    def log_intensity(self, measurement: Any) -> Float[Array, ""] | None:
        """Log intensity of measurements by targets that are born with them; None where there are none."""
        del measurement
        return None

    def seed(self, measurement: Any) -> Gaussian | None:
        """The state of a target that is born with a measurement, given it; None where there are none."""
        del measurement
        return None


class StaticBirth(Birth):
    """Targets appear around known places.

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
    """Targets may appear anywhere that the sensor sees: they are born with their first measurement.

    As many are expected everywhere in the measurement space. One that is born is measured at once, so that its weight
    after a scan with clutter and others' explanations of the measurement is exact: ``b / (kappa(z) + b + sum ...)``.

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
        return jnp.log(self.rate) - jnp.log(self.volume)

    @abstractmethod
    def seed(self, measurement: Any) -> Gaussian:
        """The state of a new target given its first measurement."""


class PointBirth(MeasuredBirth):
    """For states (position, other entries) of which a sensor measures the position.

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
        """The position as measured, all else unknown."""
        mean = jnp.concatenate([measurement, jnp.zeros_like(self.variances)])
        return Gaussian(mean, jax.scipy.linalg.block_diag(self.noise_covariance, jnp.diag(self.variances)))
