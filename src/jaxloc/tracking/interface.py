"""Interface of multi-target trackers: a filter of all targets, with their extraction."""

from abc import abstractmethod
from typing import Any

import equinox as eqx
from jaxtyping import Array, Bool, Float, Int

from jaxloc.filters import Filter, Info


class Targets(eqx.Module):
    """Estimated targets, in a fixed number of slots.

    Attributes:
        means: states, stacked along a leading axis.
        covariances: each in the tangent space of its mean.
        probabilities: that the target exists (a PHD's weights may exceed one).
        labels: number of the track of each target; it is kept from step to step.
        valid: which slots hold a target.
    """

    means: Any
    covariances: Float[Array, "k d d"]
    probabilities: Float[Array, " k"]
    labels: Int[Array, " k"]
    valid: Bool[Array, " k"]


class TrackerInfo(Info):
    """Diagnostics of an update of any tracker.

    Attributes:
        log_likelihood: of the whole set of measurements given all earlier ones, up to what the tracker approximates.
        ok: whether the state can be used.
        count: expected number of targets.
        crowded: number of components or tracks dropped for lack of room.
    """

    log_likelihood: Float[Array, ""]
    ok: Bool[Array, ""]
    count: Float[Array, ""]
    crowded: Int[Array, ""]


class Tracker(Filter):
    """A filter of many targets; the measurements of a step are a padded set with a mask `valid`.

    `jaxloc.filters.run` drives it, ``run(tracker, state, controls, measurements, valid, keep=tracker.extract)``.
    """

    @abstractmethod
    def extract(self, state: Any) -> Targets:
        """The estimated targets of a state."""
