"""Track-oriented multiple hypothesis tracking (MHT): associations are decided some scans later.

Single-target hypotheses (leaves of track trees) are stored once, and global hypotheses are lists of them, at most one
of a tree. Whether a new track is clutter is left to its existence probability, which saves a branch for each
measurement. The best children of all global hypotheses are found by one search, track by track.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy.special import logsumexp
from jaxtyping import Array, Bool, Float, Int, Key

from jaxloc import _tree as tree
from jaxloc._linalg import matmul
from jaxloc.beliefs import Mixture
from jaxloc.filters import FilterState
from jaxloc.filters.interface import conclude
from jaxloc.tracking.interface import Targets, Tracker, TrackerInfo
from jaxloc.tracking.likelihood_ratio import Scan, compare_scan, correct_tracks
from jaxloc.tracking.models.target import TargetModel
from jaxloc.tracking.tracks import NO_LABEL, ExistenceLogic, Tracks, age_tracks, miss, open_tracks, predict_tracks

_NEVER = -1e30  # log weight of impossible hypotheses
_LIGHTEST = -14.0  # log weight relative to the best hypothesis, below which one is dropped
_UNBORN = -2  # in paths: before the first measurement; -1 is a missed detection


class Hypotheses(FilterState):
    """State of the multiple hypothesis tracker.

    Attributes:
        leaves: single-target hypotheses; those of one tree share a label. Existence is conditional on the leaf.
        paths: the measurement of each leaf in the last scans, the last one first; -1 for missed, -2 before birth.
        members: leaves of each global hypothesis, -1 where there are fewer.
        log_weights: of the global hypotheses.
        step: number of predictions so far.
    """

    leaves: Tracks
    paths: Int[Array, "t n"]
    members: Int[Array, "h k"]
    log_weights: Float[Array, " h"]
    step: Int[Array, ""]

    def membership(self) -> Bool[Array, "h t"]:
        """Mask of the leaves of each global hypothesis."""
        leaf = jnp.arange(self.leaves.capacity, dtype=self.members.dtype)
        return jnp.any(self.members[:, :, None] == leaf[None, None, :], axis=1)

    def shares(self) -> Float[Array, " t"]:
        """Probability that the target of each leaf exists and took its path."""
        weights = jnp.exp(self.log_weights)
        return matmul(weights, self.membership().astype(weights.dtype)) * self.leaves.existence

    def existence(self) -> Float[Array, " t"]:
        """Probability that the target of each leaf's tree exists, summed over global hypotheses."""
        same = self.leaves.labels[:, None] == self.leaves.labels[None, :]
        shares = self.shares()
        return jnp.minimum(matmul(same.astype(shares.dtype), shares), 1.0)


class MultipleHypothesisTracker(Tracker):
    """Keeps the most probable global association hypotheses; estimates are those of the best one.

    Children are found by a beam search: tracks choose a measurement or a missed detection in turn, and the partial
    hypotheses of the largest upper bounds are kept, as many as the beam is wide. The result is exact while no more are
    possible. Hypotheses that contradict the best one more than `scans` scans back are dropped (N-scan pruning).

    Labels are unique, but not consecutive: a tree has the label of its first measurement.

    Args:
        model: the target model; its filter may be an `InteractingMultipleModel`.
        leaves: capacity for single-target hypotheses.
        tracks: largest number of tracks in a global hypothesis.
        hypotheses: number of global hypotheses kept.
        beam: number of partial hypotheses in the search, at least as many.
        scans: N of the N-scan pruning: associations are final after N scans.
        gate: probability that a track's own measurement passes; None for no gate.
        logic: when tracks are confirmed and deleted.

    Raises:
        ValueError: if the beam is narrower than the number of hypotheses, `tracks` exceeds `leaves`, or scans are none.

    References:
        Reid, "An algorithm for tracking multiple targets", IEEE TAC 1979; Kurien 1990; Brekke and Chitre,
        "Relationship between finite set statistics and the multiple hypothesis tracker", IEEE TAES 2018 [T-61].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> sensor = jl.filters.LinearSensor(jnp.eye(2, 4), jnp.eye(2))
        >>> filt = jl.filters.KalmanFilter(jl.filters.ConstantVelocity(0.1, axes=2), sensor)
        >>> birth = jl.tracking.PointBirth(0.1, 1e4, jnp.eye(2), jnp.ones(2))
        >>> clutter = jl.tracking.UniformClutter(0.1, 1e4)
        >>> model = jl.tracking.TargetModel(filt, detection=0.9, survival=0.99, clutter=clutter, birth=birth)
        >>> tracker = jl.tracking.MultipleHypothesisTracker(model, leaves=20, tracks=6, hypotheses=4, beam=8)
        >>> state = tracker.init(jl.beliefs.Mixture.empty(1, jnp.zeros(4)))
        >>> places = jnp.stack([jnp.zeros((4, 2)), jnp.full((4, 2), 9.0)], axis=1)
        >>> state, _ = jl.filters.run(tracker, state, jnp.ones(4), places, jnp.ones((4, 2), bool))
        >>> found = tracker.extract(state)
        >>> sorted(found.labels[found.valid].tolist())
        [0, 1]
    """

    model: TargetModel
    leaves: int = eqx.field(static=True, default=200)
    tracks: int = eqx.field(static=True, default=40)
    hypotheses: int = eqx.field(static=True, default=32)
    beam: int = eqx.field(static=True, default=64)
    scans: int = eqx.field(static=True, default=5)
    gate: float | None = eqx.field(static=True, default=0.999)
    logic: ExistenceLogic = eqx.field(default_factory=ExistenceLogic)

    def __check_init__(self):
        if self.beam < self.hypotheses or self.scans < 1 or self.tracks > self.leaves:
            raise ValueError(
                "A tracker needs hypotheses <= beam, tracks <= leaves and scans >= 1; got "
                f"{self.hypotheses}, {self.beam}, {self.tracks}, {self.leaves} and {self.scans}."
            )

    def init(self, prior: Mixture | None) -> Hypotheses:
        """One hypothesis of a prior, whose weights are probabilities of existence; see `open_tracks`."""
        if prior is not None and prior.capacity > self.tracks:
            raise ValueError(f"The prior has {prior.capacity} components, but a hypothesis has {self.tracks} tracks.")
        leaves = open_tracks(self.model, self.leaves, prior, self.logic)
        first = jnp.where(leaves.valid[: self.tracks], jnp.arange(self.tracks, dtype=jnp.int32), -1)
        members = jnp.full((self.hypotheses, self.tracks), -1, first.dtype).at[0].set(first)
        weights = jnp.full((self.hypotheses,), _NEVER, leaves.existence.dtype).at[0].set(0.0)
        paths = jnp.full((self.leaves, self.scans), _UNBORN, jnp.int32)
        return Hypotheses(leaves, paths, members, weights, leaves.step)

    def predict(self, state: Hypotheses, control: Any, *, key: Key[Array, ""] | None = None) -> Hypotheses:
        """Every leaf predicted one step ahead."""
        del key
        leaves = predict_tracks(self.model, state.leaves, control)
        return Hypotheses(leaves, state.paths, state.members, state.log_weights, leaves.step)

    def update(
        self, state: Hypotheses, measurement: Any, valid: Bool[Array, " m"], *, key: Key[Array, ""] | None = None
    ) -> tuple[Hypotheses, TrackerInfo]:
        """The hypotheses given a scan; the likelihood is summed over the children found."""
        del key
        ok, (after, info) = tree.protect(MultipleHypothesisTracker._updated, self, state, measurement, valid)
        return conclude(ok, after, info, state)

    def _updated(
        self, state: Hypotheses, measurement: Any, valid: Bool[Array, " m"]
    ) -> tuple[Bool[Array, ""], tuple[Hypotheses, TrackerInfo]]:
        scan = compare_scan(self.model, state.leaves, measurement, valid, self.gate)
        children = search(scan, state, self.beam)
        likelihood = scan.base + logsumexp(children.log_weights) - logsumexp(state.log_weights)
        children = jax.tree.map(lambda leaf: leaf[: self.hypotheses], children)
        after, crowded = _expand(self, state, scan, children)
        after = _resolve(after, self.logic)
        ok = tree.all_finite((after, likelihood)) & scan.usable & self.model.usable
        return ok, (after, TrackerInfo(jnp.where(ok, likelihood, 0.0), ok, jnp.sum(after.shares()), crowded))

    def extract(self, state: Hypotheses) -> Targets:
        """The confirmed tracks of the best hypothesis; their probability is that of the tree."""
        members = state.members[jnp.argmax(state.log_weights)]
        chosen = state.leaves.take(jnp.maximum(members, 0))
        existence = jnp.where(members >= 0, state.existence()[jnp.maximum(members, 0)], 0.0)
        labels = jnp.where(members >= 0, chosen.labels, NO_LABEL)
        chosen = eqx.tree_at(lambda t: (t.existence, t.labels), chosen, (existence, labels))
        found = chosen.densities()
        return Targets(found.mean, found.covariance, existence, chosen.labels, self.logic.reports(chosen))


class Children(eqx.Module):
    """Global hypotheses after a scan, best first.

    Attributes:
        parents: hypothesis before the scan.
        choices: for each member, 0 for missed, else one more than the index of its measurement.
        used: mask of the assigned measurements.
        log_weights: not normalized.
    """

    parents: Int[Array, " b"]
    choices: Int[Array, "b k"]
    used: Bool[Array, "b m"]
    log_weights: Float[Array, " b"]


def search(scan: Scan, state: Hypotheses, beam: int) -> Children:
    """Beam search for the best associations of a scan with all global hypotheses.

    Args:
        scan: compared with the leaves.
        state: hypotheses before the scan.
        beam: number of partial associations kept. They are ranked by an upper bound, the weight if the remaining
            tracks could choose without conflicts.
    """
    (num, size), (count, measured) = state.members.shape, scan.log_odds.shape
    pairs = jnp.where(jnp.isfinite(scan.log_odds), scan.log_odds, _NEVER)
    table = jnp.concatenate([scan.log_missed[:, None], pairs], axis=1)
    none = jnp.full((1, measured + 1), _NEVER, table.dtype).at[0, 0].set(0.0)
    table = jnp.concatenate([table, none])
    members = jnp.where(state.members < 0, count, state.members)
    best = jnp.max(table, axis=1)[members]
    later = jnp.cumsum(best[:, ::-1], axis=1)[:, ::-1] - best

    def choose(children, column):
        options = table[members[children.parents, column]]
        blocked = jnp.concatenate([jnp.zeros((beam, 1), bool), children.used], axis=1)
        weights = children.log_weights[:, None] + jnp.where(blocked, _NEVER, options)
        bounds = weights + later[children.parents, column][:, None]
        _, places = lax.top_k(lax.stop_gradient(bounds.reshape(-1)), beam)
        rows, choice = places // (measured + 1), places % (measured + 1)
        used = children.used[rows] | (choice[:, None] == 1 + jnp.arange(measured, dtype=choice.dtype)[None, :])
        choices = children.choices[rows].at[:, column].set(choice)
        return Children(children.parents[rows], choices, used, weights.reshape(-1)[places]), None

    fill = beam - num
    initial = Children(
        jnp.concatenate([jnp.arange(num, dtype=jnp.int32), jnp.zeros(fill, jnp.int32)]),
        jnp.zeros((beam, size), jnp.int32),
        jnp.zeros((beam, measured), bool),
        jnp.concatenate([state.log_weights, jnp.full((fill,), _NEVER, table.dtype)]),
    )
    children, _ = lax.scan(choose, initial, jnp.arange(size))
    log_weights, order = lax.top_k(jnp.maximum(children.log_weights, _NEVER), beam)
    return Children(children.parents[order], children.choices[order], children.used[order], log_weights)


def _expand(
    tracker: MultipleHypothesisTracker, state: Hypotheses, scan: Scan, children: Children
) -> tuple[Hypotheses, Int[Array, ""]]:
    """The leaves of the children, without duplicates, and the children as lists of them."""
    (count, measured), width = scan.log_odds.shape, scan.log_odds.shape[1] + 1
    # A leaf and its choice are coded as one number; new tracks follow after these.
    missed = miss(state.leaves.existence, scan.detection)
    hit = jnp.broadcast_to(state.leaves.valid[:, None], (count, measured)).astype(missed.dtype)
    existence = jnp.concatenate([jnp.concatenate([missed[:, None], hit], axis=1).reshape(-1), scan.share])
    members = state.members[children.parents]
    grown = jnp.where(members >= 0, jnp.maximum(members, 0) * width + children.choices, -1)
    born = jnp.where(children.used, -1, count * width + jnp.arange(measured, dtype=jnp.int32)[None, :])
    numbers = jnp.concatenate([grown, born], axis=1)
    kept_members = (numbers >= 0) & (existence[numbers] >= tracker.logic.delete.astype(existence.dtype))
    kept_members = kept_members & (children.log_weights > children.log_weights[0] + _LIGHTEST)[:, None]

    shares = jnp.where(kept_members, jax.nn.softmax(children.log_weights)[:, None] * existence[numbers], 0.0)
    safe = jnp.where(kept_members, numbers, 0)
    shares = jnp.zeros_like(existence).at[safe.reshape(-1)].add(shares.reshape(-1))
    kept, chosen = lax.top_k(lax.stop_gradient(shares), min(tracker.leaves, shares.shape[0]))
    there, slots = kept > 0.0, jnp.arange(chosen.shape[0], dtype=jnp.int32)
    places = jnp.full(shares.shape, -1, jnp.int32).at[chosen].set(jnp.where(there, slots, -1))
    places = jnp.where(kept_members, places[safe], -1)
    strength = jnp.where(places >= 0, existence[safe], -1.0)
    _, order = lax.top_k(lax.stop_gradient(strength), members.shape[1])
    members = jnp.take_along_axis(places, order, axis=1)
    full = jnp.max(jnp.sum(places >= 0, axis=1) - jnp.sum(members >= 0, axis=1))
    crowded = jnp.sum(shares > 0.0) - jnp.sum(there) + full

    spare = tracker.leaves - chosen.shape[0]
    chosen, there = jnp.pad(chosen, (0, spare)), jnp.pad(there, (0, spare))
    leaves, paths = _leaves(tracker.model, state, scan, chosen, jnp.where(there, existence[chosen], 0.0))
    return Hypotheses(leaves, paths, members, children.log_weights, state.step), crowded


def _leaves(
    model: TargetModel, state: Hypotheses, scan: Scan, numbers: Int[Array, " t"], existence: Float[Array, " t"]
) -> tuple[Tracks, Int[Array, "t n"]]:
    """Leaves after a scan, by the codes of leaf and choice, with their paths."""
    (count, measured), width = scan.log_odds.shape, scan.log_odds.shape[1] + 1
    newborn = numbers >= count * width
    rows = jnp.where(newborn, 0, numbers // width)
    column = jnp.where(newborn, numbers - count * width, numbers % width - 1)
    hit, safe = column >= 0, jnp.maximum(column, 0)
    old = state.leaves.take(rows)
    states = jax.vmap(tree.where)(hit, correct_tracks(model, state.leaves, scan, rows, safe), old.states)
    born = jax.tree.map(lambda leaf: leaf[safe], scan.newborn.states)
    states = jax.vmap(tree.where)(newborn, born, states)
    aged = age_tracks(eqx.tree_at(lambda t: t.existence, old, existence), states, existence, hit)
    labels = jnp.where(newborn, old.num_labels + safe, aged.labels)
    leaves = Tracks(
        states,
        existence,
        jnp.where(existence > 0.0, labels, NO_LABEL).astype(jnp.int32),
        aged.confirmed & ~newborn,
        jnp.where(newborn, 1, aged.history),
        jnp.where(newborn, 1, aged.age),
        old.num_labels + measured,
        old.step,
    )
    before = jnp.where(newborn[:, None], _UNBORN, state.paths[rows])
    return leaves, jnp.concatenate([column[:, None].astype(jnp.int32), before[:, :-1]], axis=1)


def _resolve(state: Hypotheses, logic: ExistenceLogic) -> Hypotheses:
    """N-scan pruning, merging of identical hypotheses, and confirmation of tracks."""
    leaves, member = state.leaves, state.membership()
    best = jnp.argmax(state.log_weights)
    same = (leaves.labels[:, None] == leaves.labels[None, :]) & leaves.valid[:, None] & leaves.valid[None, :]
    against = same & (state.paths[:, -1][:, None] != state.paths[:, -1][None, :])
    contradicts = jnp.any(member & jnp.any(against & member[best][None, :], axis=1)[None, :], axis=1)
    light = state.log_weights <= state.log_weights[best] + _LIGHTEST
    weights = jnp.where(contradicts | light, _NEVER, state.log_weights)

    equal = jnp.all(member[:, None, :] == member[None, :, :], axis=-1) & (weights > _NEVER)[None, :]
    first = jnp.argmax(equal, axis=1) == jnp.arange(weights.shape[0])
    total = logsumexp(jnp.where(equal, weights[None, :], _NEVER), axis=1)
    weights = jnp.where(first & (weights > _NEVER), total, _NEVER)
    weights = jnp.maximum(weights - logsumexp(weights), _NEVER)
    resolved = Hypotheses(leaves, state.paths, state.members, weights, state.step)
    updated = eqx.tree_at(lambda t: t.existence, leaves, resolved.existence())
    known = jnp.any(same & leaves.confirmed[None, :], axis=1)
    confirmed = leaves.valid & (known | logic.confirms(updated))
    return eqx.tree_at(lambda h: h.leaves.confirmed, resolved, confirmed)
