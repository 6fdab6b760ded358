"""What every tracker is: a filter of a whole scene, that says who is there."""

from abc import abstractmethod
from typing import Any

import equinox as eqx
from jaxtyping import Array, Bool, Float, Int

from jaxloc.filters import Filter, Info


class Targets(eqx.Module):
    """Who is believed to be there, with room for a fixed number.

    Attributes:
        means: states, stacked along a leading axis.
        covariances: each in the tangent space of its mean.
        probabilities: that the target exists (a PHD's weights may exceed one).
        labels: the number of its track: the same target keeps it from step to step.
        valid: which slots hold a target.
    """

    means: Any
    covariances: Float[Array, "k d d"]
    probabilities: Float[Array, " k"]
    labels: Int[Array, " k"]
    valid: Bool[Array, " k"]


class TrackerInfo(Info):
    """What an update of any tracker says.

    Attributes:
        log_likelihood: of the whole set of measurements given all earlier ones, up to what the tracker approximates.
        ok: whether the state can be used.
        count: expected number of targets.
        crowded: how many components or tracks found no room.
    """

    log_likelihood: Float[Array, ""]
    ok: Bool[Array, ""]
    count: Float[Array, ""]
    crowded: Int[Array, ""]


class Tracker(Filter):
    """A filter of many targets. Measurements of a step are a padded set, and `valid` says which there are.

    `jaxloc.filters.run` drives it, ``run(tracker, state, controls, measurements, valid, keep=tracker.extract)``.
    """

    @abstractmethod
    def extract(self, state: Any) -> Targets:
        """The targets that a state speaks of."""
