"""What FastSLAM carries from step to step: particles of paths and maps."""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxloc.beliefs import Gaussian, Particles
from jaxloc.filters.interface import FilterState
from jaxloc.poses import SE2
from jaxloc.slam.fast_slam.landmark_filter import Landmarks


class FastSlamState(FilterState):
    """Particles of paths and maps.

    Attributes:
        poses: T_world_robot, stacked along the particles.
        pending: "n d d", covariance of what is not drawn yet: of the poses by the motion since the last draw, and with
            `FromBlock` of the landmarks too.
        maps: of the particles, stacked.
        log_weights: normalized.
        step: how many predictions led here.
    """

    poses: SE2
    pending: Float[Array, "n d d"]
    maps: Landmarks
    log_weights: Float[Array, " n"]
    step: Int[Array, ""]

    def best(self) -> Int[Array, ""]:
        """The particle of largest weight."""
        return jnp.argmax(self.log_weights)

    def gaussian(self) -> Gaussian:
        """The pose as a density: mean and spread of the particles."""
        cloud = Particles(self.poses, self.log_weights)
        spread = cloud.gaussian()
        pending = jnp.sum(cloud.weights[:, None, None] * self.pending[:, :3, :3], axis=0)
        return Gaussian(spread.mean, spread.covariance + pending)

    def landmarks(self) -> Float[Array, "k 2"]:
        """The map of the best particle, m."""
        return self.maps.means[self.best()]
