"""FastSLAM with landmarks identified by descriptors and position, without landmark numbers.

All particles share the descriptors, so that a reading is compared with each once. A landmark enters a row that no
particle uses: a row means the same landmark in all of them, and is free again when the last particle that used
in it is gone.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from jaxloc._jit import filter_jit
from jaxloc.beliefs import Gaussian
from jaxloc.filters.interface import Filter, FilterState
from jaxloc.poses.lie_group import as_floats
from jaxloc.sensors.landmarks import DescribedReading
from jaxloc.slam.fast_slam.association import Candidates
from jaxloc.slam.fast_slam.fast_slam import FastSlam, FastSlamInfo
from jaxloc.slam.fast_slam.state import FastSlamState


class Appearance(eqx.Module):
    """Descriptor model: distribution of the distance between two descriptors of one landmark.

    There is no ratio test: of two landmarks with equal descriptors it would keep neither, while here their positions
    decide.

    Args:
        deviation: standard deviation of their distance, in units of the descriptor.
        reach: the distance beyond which they are not of one landmark; None for three deviations.
        new_density: density of readings of new landmarks whose descriptor matches a known one, per meter and radian:
            how often there is one, over the area where it may lie. None for one in a thousand of the density at a
            perfectly known one.

    Example:
        >>> import jax.numpy as jnp
        >>> from jaxloc.slam.fast_slam import Appearance
        >>> alike, log_ratios = Appearance(0.5).compare(jnp.array([[1.0, 0.0], [1.0, 4.0]]), jnp.array([1.0, 1.0]))
        >>> alike.tolist(), log_ratios.tolist()
        ([True, False], [-2.0, 0.0])
    """

    deviation: Float[Array, ""]
    reach: Float[Array, ""]
    log_new: Float[Array, ""] | None

    def __init__(self, deviation: Any, *, reach: Any = None, new_density: Any = None):
        (self.deviation,) = as_floats(deviation)
        self.reach = 3.0 * self.deviation if reach is None else as_floats(reach)[0]
        self.log_new = None if new_density is None else jnp.log(as_floats(new_density)[0])

    def compare(
        self, known: Float[Array, "k d"], descriptor: Float[Array, " d"]
    ) -> tuple[Bool[Array, " k"], Float[Array, " k"]]:
        """Candidate landmarks of a descriptor, and their log-likelihood ratios."""
        squared = jnp.sum((known - descriptor[None]) ** 2, axis=1)
        alike = squared <= self.reach**2
        return alike, jnp.where(alike, -0.5 * jnp.where(alike, squared, 0.0) / self.deviation**2, 0.0)


class Appearances(eqx.Module):
    """Descriptors of the map, shared by all particles.

    Attributes:
        descriptors: "k d", mean of the readings of each row, weighted by the particles that use them.
        readings: how many those are.
    """

    descriptors: Float[Array, "k d"]
    readings: Float[Array, " k"]

    def include(self, descriptor: Float[Array, " d"], shares: Float[Array, " k"]) -> "Appearances":
        """The map's descriptors updated by one more, with a weight per landmark."""
        readings = self.readings + shares
        gains = jnp.where(shares > 0.0, shares / jnp.where(shares > 0.0, readings, 1.0), 0.0)
        blend = (1.0 - gains)[:, None] * self.descriptors + gains[:, None] * descriptor[None]
        return Appearances(blend, readings)


class DescriptorSlamState(FilterState):
    """State of `DescriptorFastSlam`: particles of paths and maps, and the descriptors of the landmarks.

    Attributes:
        slam: poses and maps.
        appearances: of the rows of all maps.
    """

    slam: FastSlamState
    appearances: Appearances

    @property
    def step(self) -> Int[Array, ""]:
        """Number of predictions so far."""
        return self.slam.step

    def gaussian(self) -> Gaussian:
        """Gaussian of the pose: mean and covariance of the particles."""
        return self.slam.gaussian()

    def landmarks(self) -> Float[Array, "k 2"]:
        """Landmark positions of the particle with the largest weight, m."""
        return self.slam.landmarks()


class DescriptorFastSlam(Filter):
    """`FastSlam` with landmarks identified by descriptors, such as SIFT.

    Each particle takes a reading for the landmark of its map whose descriptor matches, lies within the gate and is the
    likeliest by both, or for a new one. Readings that have a number keep it.

    Attributes:
        slam: particles, motion and sensor.
        appearance: how alike two descriptors of one landmark are.
        length: of a descriptor.

    References:
        Sim, Elinas, Griffin, Little, "Vision-based SLAM using the Rao-Blackwellised particle filter", IJCAI workshop on
        reasoning with uncertainty in robotics, 2005; review section 3.3.1 [R-21].

    Example:
        >>> import jax, jax.numpy as jnp, jaxloc as jl
        >>> from jaxloc.slam.fast_slam import Appearance, DescriptorFastSlam
        >>> slam = jl.slam.FastSlam(jl.sensors.IncrementMotion(), 0.1, 0.02, num_particles=10, capacity=4)
        >>> filt = DescriptorFastSlam(slam, Appearance(0.1), length=2)
        >>> state = filt.init(jl.beliefs.Gaussian(jl.poses.SE2(0.0, 0.0, 0.0), 1e-6 * jnp.eye(3)))
        >>> reading = jl.sensors.RangeBearing(jnp.array(5.0), jl.poses.SO2.identity(), jnp.array(-1))
        >>> for descriptor in ([0.0, 1.0], [1.0, 0.0], [0.0, 1.0]):  # at one place, by turns
        ...     seen = jl.sensors.DescribedReading(reading, jnp.array(descriptor))
        ...     state, info = filt.update(state, seen, jnp.array(True), key=jax.random.key(0))
        >>> state.slam.maps.support[0].tolist()
        [2, 1, 0, 0]
    """

    slam: FastSlam
    appearance: Appearance
    length: int = eqx.field(static=True)

    def init(self, prior: Gaussian) -> DescriptorSlamState:
        """Initial state: particles at the mean of the prior, and an empty map."""
        slam, dtype = self.slam.init(prior), prior.covariance.dtype
        capacity = self.slam.capacity
        none = Appearances(jnp.zeros((capacity, self.length), dtype), jnp.zeros(capacity, dtype))
        return DescriptorSlamState(slam, none)

    @filter_jit
    def predict(
        self, state: DescriptorSlamState, control: Any, *, key: Key[Array, ""] | None = None
    ) -> DescriptorSlamState:
        """Predicts all particles."""
        return DescriptorSlamState(self.slam.predict(state.slam, control, key=key), state.appearances)

    @filter_jit
    def update(
        self,
        state: DescriptorSlamState,
        measurement: DescribedReading,
        valid: Bool[Array, ""],
        *,
        key: Key[Array, ""] | None = None,
    ) -> tuple[DescriptorSlamState, FastSlamInfo]:
        """Updates by one reading, as `FastSlam.update`; one with a non-finite descriptor is ignored.

        Raises:
            ValueError: without a key, or with descriptors of another length.
        """
        if measurement.descriptor.shape != (self.length,):
            raise ValueError(f"Descriptors have {self.length} numbers here, not {measurement.descriptor.shape}.")
        usable = valid & jnp.isfinite(jnp.sum(measurement.descriptor**2))
        descriptor = jnp.where(usable, measurement.descriptor, 0.0)
        used = jnp.any(state.slam.maps.seen, axis=0)
        candidates = self._candidates(state.appearances, descriptor, used)
        slam, info = self.slam.update_among(state.slam, measurement.reading, usable, candidates, key=key)
        shares = _shares(slam, info, self.slam.capacity)
        # A row that was free has forgotten what it looked like.
        before = Appearances(state.appearances.descriptors, jnp.where(used, state.appearances.readings, 0.0))
        return DescriptorSlamState(slam, before.include(descriptor, shares)), info

    def _candidates(self, known: Appearances, descriptor: Array, used: Array) -> Candidates:
        alike, log_ratios = self.appearance.compare(known.descriptors, descriptor)
        free = jnp.where(jnp.all(used), self.slam.capacity, jnp.argmin(used)).astype(jnp.int32)
        log_new = self.slam.landmark_filter.log_floor() if self.appearance.log_new is None else self.appearance.log_new
        return Candidates(alike & used, log_ratios, log_new.astype(descriptor.dtype), free)


def _shares(slam: FastSlamState, info: FastSlamInfo, capacity: int) -> Float[Array, " k"]:
    """The weight of the particles, as they are now, that took the reading for each row."""
    rows = info.landmark[info.ancestors]
    taken = rows[:, None] == jnp.arange(capacity, dtype=rows.dtype)[None, :]
    return jnp.sum(jnp.where(taken, jnp.exp(slam.log_weights)[:, None], 0.0), axis=0)
