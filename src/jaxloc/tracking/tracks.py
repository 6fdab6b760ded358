"""Track management: a fixed-size table of tracks, with their initiation, confirmation and deletion."""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key

from jaxloc import _tree as tree
from jaxloc.beliefs import Gaussian, Mixture
from jaxloc.filters import FilterState
from jaxloc.filters.interface import conclude
from jaxloc.poses.lie_group import as_floats
from jaxloc.tracking.interface import Targets, TrackerInfo
from jaxloc.tracking.models.birth import StaticBirth
from jaxloc.tracking.models.target import TargetModel

_HISTORY_LENGTH = 31  # scans, one bit of an integer each
NO_LABEL = -1


class Tracks(FilterState):
    """Table of tracks with one density each; empty slots have existence zero and label -1.

    Attributes:
        states: filter states of the tracks, stacked along a leading axis.
        existence: probability that the target exists.
        labels: number of each track, unique.
        confirmed: which tracks have been confirmed.
        history: one bit per scan, the last scan lowest: whether the track was measured.
        age: scans since the first measurement, including that one.
        num_labels: number of labels given so far.
        step: number of predictions so far.
    """

    states: Any
    existence: Float[Array, " k"]
    labels: Int[Array, " k"]
    confirmed: Bool[Array, " k"]
    history: Int[Array, " k"]
    age: Int[Array, " k"]
    num_labels: Int[Array, ""]
    step: Int[Array, ""]

    @property
    def capacity(self) -> int:
        """Number of slots."""
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
        """Some of the tracks, by their slots."""
        slots = jax.tree.map(lambda leaf: leaf[indices], _slots(self))
        return Tracks(*slots, self.num_labels, self.step)


class TrackLogic(eqx.Module):
    """When tracks are confirmed, deleted and reported."""

    @abstractmethod
    def confirms(self, tracks: Tracks) -> Bool[Array, " k"]:
        """Which tracks pass the test of confirmation; a track stays confirmed until it is deleted."""

    @abstractmethod
    def keeps(self, tracks: Tracks) -> Bool[Array, " k"]:
        """Which tracks are not deleted."""

    @abstractmethod
    def reports(self, tracks: Tracks) -> Bool[Array, " k"]:
        """Which tracks are reported as targets."""


class ExistenceLogic(TrackLogic):
    """Track management by the probability of existence.

    Args:
        confirm: tracks above it are confirmed.
        delete: tracks below it are deleted. Choose it below the existence of a newborn track, which is
            ``b / (kappa + b)``.
        report: confirmed tracks are reported while they are above it.

    References:
        Musicki, Evans and Stankovic, "Integrated probabilistic data association", IEEE TAC 1994 [T-59].
    """

    confirm: Float[Array, ""]
    delete: Float[Array, ""]
    report: Float[Array, ""]

    def __init__(self, confirm: Any = 0.9, delete: Any = 1e-4, report: Any = 0.5):
        self.confirm, self.delete, self.report = as_floats(confirm, delete, report)

    def confirms(self, tracks: Tracks) -> Bool[Array, " k"]:
        """At or above the confirmation threshold."""
        return tracks.existence >= self.confirm.astype(tracks.existence.dtype)

    def keeps(self, tracks: Tracks) -> Bool[Array, " k"]:
        """At or above the deletion threshold."""
        return tracks.valid & (tracks.existence >= self.delete.astype(tracks.existence.dtype))

    def reports(self, tracks: Tracks) -> Bool[Array, " k"]:
        """Confirmed, and at or above the report threshold."""
        return tracks.confirmed & tracks.valid & (tracks.existence >= self.report.astype(tracks.existence.dtype))


class HistoryLogic(TrackLogic):
    """M-of-N track management: confirmed by M measurements in N scans, deleted after consecutive misses.

    Args:
        hits: M, number of measurements that confirm a track.
        scans: N, length of the window; a tentative track that is not confirmed within it is deleted.
        misses: number of consecutive scans without a measurement that deletes a track.

    Raises:
        ValueError: if the counts are not ``1 <= hits <= scans <= 31`` and ``1 <= misses <= 31``.

    References:
        Blackman and Popoli, *Design and Analysis of Modern Tracking Systems*, 1999, section 6.2 [T-58].
    """

    hits: int = eqx.field(static=True, default=3)
    scans: int = eqx.field(static=True, default=5)
    misses: int = eqx.field(static=True, default=4)

    def __check_init__(self):
        if not (1 <= self.hits <= self.scans <= _HISTORY_LENGTH and 1 <= self.misses <= _HISTORY_LENGTH):
            raise ValueError(
                f"Counts must be 1 <= hits <= scans <= {_HISTORY_LENGTH} and 1 <= misses <= {_HISTORY_LENGTH}; got "
                f"hits={self.hits}, scans={self.scans}, misses={self.misses}."
            )

    def confirms(self, tracks: Tracks) -> Bool[Array, " k"]:
        """M measurements in the last N scans."""
        return lax.population_count(tracks.history & _bits(self.scans)) >= self.hits

    def keeps(self, tracks: Tracks) -> Bool[Array, " k"]:
        """Measured recently, and confirmed or not older than the window."""
        measured = (tracks.history & _bits(self.misses)) != 0
        return tracks.valid & measured & (tracks.confirmed | self.confirms(tracks) | (tracks.age < self.scans))

    def reports(self, tracks: Tracks) -> Bool[Array, " k"]:
        """All confirmed tracks."""
        return tracks.confirmed & tracks.valid


class TrackTable(eqx.Module):
    """Options, and the steps that follow from them, of trackers with one density per track.

    Args:
        model: the target model.
        capacity: number of slots for tracks, tentative ones included.
        gate: probability that a track's own measurement passes; None for no gate.
        logic: when tracks are confirmed and deleted.
    """

    model: TargetModel
    capacity: int = eqx.field(static=True, default=100)
    gate: float | None = eqx.field(static=True, default=0.999)
    logic: TrackLogic = eqx.field(default_factory=ExistenceLogic)

    def init(self, prior: Mixture | None) -> Tracks:
        """Tracks of a prior, whose weights are probabilities of existence; see `open_tracks`."""
        return open_tracks(self.model, self.capacity, prior, self.logic)

    def predict(self, state: Tracks, control: Any, *, key: Key[Array, ""] | None = None) -> Tracks:
        """Every track predicted one step ahead."""
        del key
        return predict_tracks(self.model, state, control)

    def update(
        self, state: Tracks, measurement: Any, valid: Bool[Array, " m"], *, key: Key[Array, ""] | None = None
    ) -> tuple[Tracks, TrackerInfo]:
        """The tracks given a scan; as predicted where the scan cannot be used."""
        del key
        ok, (after, info) = tree.protect(_associated, self, state, measurement, valid)
        return conclude(ok, after, info, state)

    @abstractmethod
    def associate_scan(self, state: Tracks, measurement: Any, valid: Bool[Array, " m"]) -> tuple[Tracks, TrackerInfo]:
        """`update` without protection from non-finite numbers, which `update` adds."""

    def extract(self, state: Tracks) -> Targets:
        """The reported tracks."""
        return extract_tracks(state, self.logic)


def _associated(
    table: TrackTable, state: Tracks, measurement: Any, valid: Bool[Array, " m"]
) -> tuple[Bool[Array, ""], tuple[Tracks, TrackerInfo]]:
    after, info = table.associate_scan(state, measurement, valid)
    return info.ok & table.model.usable, (after, info)


def open_tracks(model: TargetModel, capacity: int, prior: Mixture | None, logic: TrackLogic) -> Tracks:
    """The initial table of tracks.

    Args:
        model: the target model.
        capacity: number of slots.
        prior: possible targets, whose weights are probabilities of existence; ``Mixture.empty(1, example)`` for none.
            May be None where the births of the model are a mixture.
        logic: when a track is confirmed.

    Raises:
        ValueError: if there is no example of a state, or the prior has more components than there are slots.
    """
    if prior is None and isinstance(model.birth, StaticBirth):
        prior = model.birth.intensity.take(jnp.zeros(1, jnp.int32)).scaled(0.0)
    if prior is None or prior.capacity == 0:
        raise ValueError("There is no example of a state; give Mixture.empty(1, example) with any state.")
    if prior.capacity > capacity:
        raise ValueError(f"The prior has {prior.capacity} components, but the table has {capacity} slots.")
    padded = prior.check().usable().padded(capacity)
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
    return eqx.tree_at(lambda t: t.confirmed, tracks, logic.confirms(tracks) & there)


def predict_tracks(model: TargetModel, tracks: Tracks, control: Any) -> Tracks:
    """Every track predicted one step ahead; existence is multiplied by the survival probability."""
    states = jax.vmap(lambda state: model.filter.predict(state, control))(tracks.states)
    existence = tracks.existence * model.survival_probability().astype(tracks.existence.dtype)
    return eqx.tree_at(lambda t: (t.states, t.existence, t.step), tracks, (states, existence, tracks.step + 1))


def miss(existence: Float[Array, " k"], detection: Float[Array, " k"]) -> Float[Array, " k"]:
    """Existence after a missed detection: ``r (1 - p_D) / (1 - r p_D)``.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> round(float(jl.tracking.tracks.miss(jnp.array([0.5]), jnp.array([0.9]))[0]), 3)
        0.091
    """
    rest = 1.0 - existence * detection
    return existence * (1.0 - detection) / jnp.where(rest > 0.0, rest, 1.0)


def age_tracks(tracks: Tracks, states: Any, existence: Float[Array, " k"], hit: Bool[Array, " k"]) -> Tracks:
    """The tracks with the results of a scan, and their histories extended.

    Args:
        tracks: as predicted.
        states: after the scan.
        existence: after the scan.
        hit: which were measured.
    """
    existence = jnp.where(tracks.valid, existence, 0.0)
    history = _bits(_HISTORY_LENGTH) & (2 * (tracks.history & _bits(_HISTORY_LENGTH - 1)) + hit.astype(jnp.int32))
    return Tracks(
        states, existence, tracks.labels, tracks.confirmed, history, tracks.age + 1, tracks.num_labels, tracks.step
    )


def manage_tracks(
    tracks: Tracks, states: Any, existence: Float[Array, " m"], logic: TrackLogic
) -> tuple[Tracks, Int[Array, ""]]:
    """Confirms, deletes and initiates tracks; where slots run out, the tracks of least existence are dropped.

    Args:
        tracks: after a scan.
        states: of new tracks, stacked.
        existence: of new tracks; zero where there is none.
        logic: track management.

    Returns:
        The table, and the number of tracks dropped for lack of slots.
    """
    num = existence.shape[0]
    unlabeled, first = jnp.full((num,), NO_LABEL, jnp.int32), jnp.ones(num, jnp.int32)
    born = Tracks(states, existence, unlabeled, jnp.zeros(num, bool), first, first, tracks.num_labels, tracks.step)
    both = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), _slots(tracks), _slots(born))
    all_tracks = Tracks(*both, tracks.num_labels, tracks.step)
    remaining = logic.keeps(all_tracks)
    confirmed = remaining & (all_tracks.confirmed | logic.confirms(all_tracks))
    strength = jnp.where(remaining, all_tracks.existence + confirmed.astype(existence.dtype), -1.0)
    _, order = lax.top_k(lax.stop_gradient(strength), tracks.capacity)
    kept = eqx.tree_at(lambda t: t.confirmed, all_tracks, confirmed).take(order)
    stays = remaining[order]
    new = stays & (kept.labels == NO_LABEL)
    numbers = tracks.num_labels + jnp.cumsum(new, dtype=jnp.int32) - 1
    labels = jnp.where(new, numbers, jnp.where(stays, kept.labels, NO_LABEL))
    num_labels = tracks.num_labels + jnp.sum(new, dtype=jnp.int32)
    existence = jnp.where(stays, kept.existence, 0.0)
    table = Tracks(kept.states, existence, labels, kept.confirmed, kept.history, kept.age, num_labels, tracks.step)
    return table, jnp.sum(remaining) - jnp.sum(stays)


def extract_tracks(tracks: Tracks, logic: TrackLogic) -> Targets:
    """The reported tracks as targets."""
    found = tracks.densities()
    return Targets(found.mean, found.covariance, tracks.existence, tracks.labels, logic.reports(tracks))


def _slots(tracks: Tracks) -> tuple:
    return tracks.states, tracks.existence, tracks.labels, tracks.confirmed, tracks.history, tracks.age


def _bits(scans: int) -> int:
    return (1 << scans) - 1
