"""A table of tracks with room for a fixed number, and their life: tentative, confirmed, gone."""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxloc.beliefs import Gaussian, Mixture
from jaxloc.filters import FilterState
from jaxloc.poses.lie_group import as_floats
from jaxloc.tracking.interface import Targets
from jaxloc.tracking.models.birth import StaticBirth
from jaxloc.tracking.models.target import TargetModel

_REMEMBERED = 31  # scans, in the bits of an integer
NO_LABEL = -1


class Tracks(FilterState):
    """What a tracker with one density a track carries. Empty slots have existence zero and label -1.

    Attributes:
        states: of the filter of one target, stacked along a leading axis.
        existence: probability that the target is there.
        labels: the number of each track; none is given twice.
        confirmed: which tracks have been believed once.
        recent: one bit a scan, the last one lowest: whether the track was measured.
        age: scans since the first measurement, that one included.
        given: labels given so far.
        step: how many predictions led here.
    """

    states: Any
    existence: Float[Array, " k"]
    labels: Int[Array, " k"]
    confirmed: Bool[Array, " k"]
    recent: Int[Array, " k"]
    age: Int[Array, " k"]
    given: Int[Array, ""]
    step: Int[Array, ""]

    @property
    def capacity(self) -> int:
        """How many tracks there is room for."""
        return self.existence.shape[0]

    @property
    def valid(self) -> Bool[Array, " k"]:
        """Which slots hold a track."""
        return self.existence > 0.0

    def densities(self) -> Gaussian:
        """The normal density of each track, stacked."""
        return jax.vmap(lambda state: state.gaussian())(self.states)

    def means(self) -> Any:
        """The mean of each track, stacked."""
        return self.densities().mean

    def take(self, indices: Int[Array, " n"]) -> "Tracks":
        """Some of the tracks, by their places."""
        slots = jax.tree.map(lambda leaf: leaf[indices], _slots(self))
        return Tracks(*slots, self.given, self.step)


class Life(eqx.Module):
    """When a track is believed, and when it is given up."""

    @abstractmethod
    def confirms(self, tracks: Tracks) -> Bool[Array, " k"]:
        """Which tracks deserve belief now; they keep it as long as they live."""

    @abstractmethod
    def keeps(self, tracks: Tracks) -> Bool[Array, " k"]:
        """Which tracks live on."""

    @abstractmethod
    def shows(self, tracks: Tracks) -> Bool[Array, " k"]:
        """Which tracks are spoken of."""


class ExistenceLife(Life):
    """By the probability of existence.

    Args:
        confirm: tracks above it are confirmed.
        delete: tracks below it are deleted. Choose it below the existence of a newborn track, which is
            ``b / (kappa + b)``.
        show: confirmed tracks are spoken of while they are above it.

    References:
        Musicki, Evans and Stankovic, "Integrated probabilistic data association", IEEE TAC 1994 [T-59].
    """

    confirm: Float[Array, ""]
    delete: Float[Array, ""]
    show: Float[Array, ""]

    def __init__(self, confirm: Any = 0.9, delete: Any = 1e-4, show: Any = 0.5):
        self.confirm, self.delete, self.show = as_floats(confirm, delete, show)

    def confirms(self, tracks: Tracks) -> Bool[Array, " k"]:
        """Above one threshold."""
        return tracks.existence >= self.confirm.astype(tracks.existence.dtype)

    def keeps(self, tracks: Tracks) -> Bool[Array, " k"]:
        """Above another."""
        return tracks.valid & (tracks.existence >= self.delete.astype(tracks.existence.dtype))

    def shows(self, tracks: Tracks) -> Bool[Array, " k"]:
        """Confirmed, and more likely there than not."""
        return tracks.confirmed & tracks.valid & (tracks.existence >= self.show.astype(tracks.existence.dtype))


class CountLife(Life):
    """By counting: confirmed after M measurements in N scans, deleted after too many scans without any.

    Args:
        hits: M, measurements that confirm a track.
        scans: N, the scans they must come in; a tentative track that fails is deleted.
        misses: scans in a row without a measurement that end a track.

    Raises:
        ValueError: if the counts are not ``1 <= hits <= scans <= 31`` and ``1 <= misses <= 31``.

    References:
        Blackman and Popoli, *Design and Analysis of Modern Tracking Systems*, 1999, section 6.2 [T-58].
    """

    hits: int = eqx.field(static=True, default=3)
    scans: int = eqx.field(static=True, default=5)
    misses: int = eqx.field(static=True, default=4)

    def __check_init__(self):
        if not (1 <= self.hits <= self.scans <= _REMEMBERED and 1 <= self.misses <= _REMEMBERED):
            raise ValueError(
                f"Counts must be 1 <= hits <= scans <= {_REMEMBERED} and 1 <= misses <= {_REMEMBERED}; got "
                f"hits={self.hits}, scans={self.scans}, misses={self.misses}."
            )

    def confirms(self, tracks: Tracks) -> Bool[Array, " k"]:
        """M measurements in the last N scans."""
        return lax.population_count(tracks.recent & _last(self.scans)) >= self.hits

    def keeps(self, tracks: Tracks) -> Bool[Array, " k"]:
        """Measured lately, and confirmed or still on probation."""
        measured = (tracks.recent & _last(self.misses)) != 0
        return tracks.valid & measured & (tracks.confirmed | self.confirms(tracks) | (tracks.age < self.scans))

    def shows(self, tracks: Tracks) -> Bool[Array, " k"]:
        """All that are confirmed."""
        return tracks.confirmed & tracks.valid


def open_tracks(model: TargetModel, capacity: int, prior: Mixture | None, life: Life) -> Tracks:
    """A table before any data.

    Args:
        model: what targets do.
        capacity: how many tracks there is room for.
        prior: targets that may be there, weights are their probabilities; ``Mixture.empty(1, example)`` for nothing
            yet. None will do where the births of the model are a mixture.
        life: when a track is believed.

    Raises:
        ValueError: if nothing says what a state looks like, or the prior has more components than there is room for.
    """
    if prior is None and isinstance(model.birth, StaticBirth):
        prior = model.birth.intensity.take(jnp.zeros(1, jnp.int32)).scaled(0.0)
    if prior is None or prior.capacity == 0:
        raise ValueError("Nothing says what a state looks like; give Mixture.empty(1, example) with any state.")
    if prior.capacity > capacity:
        raise ValueError(f"The prior has {prior.capacity} components, but there is room for {capacity} tracks.")
    padded = prior.check().padded(capacity)
    existence = jnp.minimum(padded.weights, 1.0)
    there = existence > 0.0
    labels = jnp.where(there, jnp.cumsum(there, dtype=jnp.int32) - 1, NO_LABEL)
    states = jax.vmap(lambda mean, covariance: model.filter.init(Gaussian(mean, covariance)))(
        padded.means, padded.covariances
    )
    known, zero = there.astype(jnp.int32), jnp.zeros((), jnp.int32)
    tracks = Tracks(
        states, existence, labels, jnp.zeros(capacity, bool), known, known, jnp.sum(known, dtype=jnp.int32), zero
    )
    return eqx.tree_at(lambda t: t.confirmed, tracks, life.confirms(tracks) & there)


def predict_tracks(model: TargetModel, tracks: Tracks, control: Any) -> Tracks:
    """Every track one step later; some may have left."""
    states = jax.vmap(lambda state: model.filter.predict(state, control))(tracks.states)
    existence = tracks.existence * model.survival.astype(tracks.existence.dtype)
    return eqx.tree_at(lambda t: (t.states, t.existence, t.step), tracks, (states, existence, tracks.step + 1))


def miss(existence: Float[Array, " k"], detection: Float[Array, " k"]) -> Float[Array, " k"]:
    """Existence after a scan in which a track was not measured: ``r (1 - p_D) / (1 - r p_D)``.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> round(float(jl.tracking.tracks.miss(jnp.array([0.5]), jnp.array([0.9]))[0]), 3)
        0.091
    """
    rest = 1.0 - existence * detection
    return existence * (1.0 - detection) / jnp.where(rest > 0.0, rest, 1.0)


def age_tracks(tracks: Tracks, states: Any, existence: Float[Array, " k"], hit: Bool[Array, " k"]) -> Tracks:
    """The tracks with what a scan says of them.

    Args:
        tracks: as predicted.
        states: after the scan.
        existence: after the scan.
        hit: which were measured.
    """
    existence = jnp.where(tracks.valid, existence, 0.0)
    recent = _last(_REMEMBERED) & (2 * (tracks.recent & _last(_REMEMBERED - 1)) + hit.astype(jnp.int32))
    return Tracks(states, existence, tracks.labels, tracks.confirmed, recent, tracks.age + 1, tracks.given, tracks.step)


def renew(tracks: Tracks, states: Any, existence: Float[Array, " m"], life: Life) -> tuple[Tracks, Int[Array, ""]]:
    """Confirms, deletes, and gives newborn tracks a place: when there is none, the weakest give way.

    Args:
        tracks: after a scan.
        states: of newborn tracks, stacked.
        existence: of newborn tracks; zero where there is none.
        life: what decides.

    Returns:
        The table, and how many tracks found no room.
    """
    num = existence.shape[0]
    nobody, first = jnp.full((num,), NO_LABEL, jnp.int32), jnp.ones(num, jnp.int32)
    born = Tracks(states, existence, nobody, jnp.zeros(num, bool), first, first, tracks.given, tracks.step)
    both = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), _slots(tracks), _slots(born))
    everyone = Tracks(*both, tracks.given, tracks.step)
    alive = life.keeps(everyone)
    confirmed = alive & (everyone.confirmed | life.confirms(everyone))
    strength = jnp.where(alive, everyone.existence + confirmed.astype(existence.dtype), -1.0)
    _, order = lax.top_k(lax.stop_gradient(strength), tracks.capacity)
    kept = eqx.tree_at(lambda t: t.confirmed, everyone, confirmed).take(order)
    stays = alive[order]
    new = stays & (kept.labels == NO_LABEL)
    numbers = tracks.given + jnp.cumsum(new, dtype=jnp.int32) - 1
    labels = jnp.where(new, numbers, jnp.where(stays, kept.labels, NO_LABEL))
    given = tracks.given + jnp.sum(new, dtype=jnp.int32)
    existence = jnp.where(stays, kept.existence, 0.0)
    table = Tracks(kept.states, existence, labels, kept.confirmed, kept.recent, kept.age, given, tracks.step)
    return table, jnp.sum(alive) - jnp.sum(stays)


def extract_tracks(tracks: Tracks, life: Life) -> Targets:
    """The targets that the tracks speak of."""
    found = tracks.densities()
    return Targets(found.mean, found.covariance, tracks.existence, tracks.labels, life.shows(tracks))


def _slots(tracks: Tracks) -> tuple:
    return tracks.states, tracks.existence, tracks.labels, tracks.confirmed, tracks.recent, tracks.age


def _last(scans: int) -> int:
    return (1 << scans) - 1
