"""State of FastSLAM: particles of paths and maps."""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxloc.beliefs import Gaussian, Particles
from jaxloc.filters.interface import FilterState
from jaxloc.poses import SE2
from jaxloc.slam.fast_slam.landmark_filter import Landmarks


class FastSlamState(FilterState):
    """State of FastSLAM: weighted particles of paths and maps.

    Attributes:
        poses: T_world_robot, stacked along the particles.
        pending: "n d d", covariance of what is not drawn yet: of the poses by the motion since the last draw, and with
            `BlockProposal` of the landmarks too.
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
        """The particle with the largest weight."""
        return jnp.argmax(self.log_weights)

    def gaussian(self) -> Gaussian:
        """Gaussian of the pose: mean and covariance of the particles."""
        cloud = Particles(self.poses, self.log_weights)
        moments = cloud.gaussian()
        pending = jnp.sum(cloud.weights[:, None, None] * self.pending[:, :3, :3], axis=0)
        return Gaussian(moments.mean, moments.covariance + pending)

    def landmarks(self) -> Float[Array, "k 2"]:
        """Landmark positions of the particle with the largest weight, m."""
        return self.maps.means[self.best()]
