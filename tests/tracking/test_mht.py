"""Multiple hypothesis tracking: its search against enumeration, and identities that later scans put right."""  # T-61

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxloc as jl
from jaxloc.filters import run
from jaxloc.tracking import likelihood_ratio, mht, tracks


def make_model(intensity=0.01, variance=0.25, *, clutter=1.0, birth=0.01, detection=0.9):
    motion = jl.filters.ConstantVelocity(intensity, axes=2)
    filt = jl.filters.KalmanFilter(motion, jl.filters.LinearSensor(jnp.eye(2, 4), variance * jnp.eye(2)))
    return jl.tracking.TargetModel(
        filt,
        detection=detection,
        survival=0.99,
        clutter=jl.tracking.UniformClutter(clutter, 1e4),
        birth=jl.tracking.PointBirth(birth, 1e4, variance * jnp.eye(2), jnp.full(2, 4.0)),
    )


def make_tracker(model=None, **options):
    settings = {"leaves": 40, "tracks": 6, "hypotheses": 12, "beam": 24, "scans": 6} | options
    return jl.tracking.MultipleHypothesisTracker(make_model() if model is None else model, **settings)


@eqx.filter_jit
def update(tracker, state, z, valid):
    return tracker.update(state, z, valid)


def no_targets():
    return jl.beliefs.Mixture.empty(1, jnp.zeros(4))


def two_tracks(*states):
    means = jnp.array(states)
    return jl.beliefs.Mixture(jnp.full(2, 0.999), means, jnp.stack([0.1 * jnp.eye(4)] * 2))


def test_search_is_enumeration(rng):
    tracker = make_tracker(hypotheses=2, beam=200)
    state = tracker.init(two_tracks([0.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]))
    odds = jnp.asarray(rng.normal(size=(40, 3)), jnp.float32).at[0, 1].set(-jnp.inf)
    missed = jnp.asarray(np.log(rng.uniform(size=40)), jnp.float32)
    members = jnp.array([[0, 1, -1, 2, -1, -1], [3, -1, -1, -1, -1, -1]], jnp.int32)
    weights = jnp.log(jnp.array([0.7, 0.3]))
    seen = eqx.filter_jit(likelihood_ratio.compare_scan)(
        tracker.model, state.leaves, jnp.zeros((3, 2)), jnp.ones(3, bool), None
    )
    seen = eqx.tree_at(lambda s: (s.log_odds, s.log_missed), seen, (odds, missed))
    state = mht.Hypotheses(state.leaves, state.paths, members, weights, state.step)
    search = eqx.filter_jit(mht.search)
    found = search(seen, state, 200)

    table = np.concatenate([np.asarray(missed)[:, None], np.asarray(odds)], axis=1)
    expected = []
    for start, rows in zip(np.asarray(weights), ([0, 1, 2], [3]), strict=True):
        for choice in itertools.product(range(4), repeat=len(rows)):
            taken = [c for c in choice if c > 0]
            total = start + sum(table[row, c] for row, c in zip(rows, choice, strict=True))
            if len(set(taken)) == len(taken) and np.isfinite(total):
                expected.append(total)
    expected = np.sort(expected)[::-1]
    np.testing.assert_allclose(found.log_weights[: len(expected)], expected, rtol=1e-5)
    assert bool(jnp.all(found.log_weights[len(expected) :] < -1e20))
    # A narrow beam finds the best one here as well.
    narrow = search(seen, state, 4)
    np.testing.assert_allclose(narrow.log_weights[0], expected[0], rtol=1e-5)


def identities_kept(tracker, prior, truth, z, valid):
    """Over all runs, whether both targets are where they should be under the labels that they began with."""
    start = tracker.init(prior)

    @jax.jit
    @jax.vmap
    def last(places, there):
        state, history = run(tracker, start, jnp.ones(places.shape[0]), places, there)
        return tracker.extract(state), jnp.all(history.infos.ok)

    found, ok = last(z, valid)
    assert bool(jnp.all(ok))
    distance = np.linalg.norm(truth[None, :, None] - np.asarray(found.means)[:, None, :, :2], axis=-1)
    nearest = np.where(np.asarray(found.valid)[:, None], distance, np.inf).argmin(axis=2)
    labels = np.take_along_axis(np.asarray(found.labels), nearest, axis=1)
    return int((labels == [0, 1]).all(axis=1).sum())


@pytest.mark.slow
def test_identities_through_a_crossing():
    # Where the targets cross, one is missed three times; nearest neighbors then often give it the other's way.
    times = np.arange(-8.0, 9.0)
    truth = np.stack([np.stack([times, 0.5 * times], 1), np.stack([times, -0.5 * times], 1)], axis=1)
    z = np.stack([truth + np.random.default_rng(k).normal(scale=0.5, size=truth.shape) for k in range(64)])
    z, valid = jnp.asarray(z, jnp.float32), jnp.ones((64, 17, 2), bool).at[:, 8:11, 0].set(False)
    prior, model = two_tracks([-9.0, -4.5, 1.0, 0.5], [-9.0, 4.5, 1.0, -0.5]), make_model(intensity=0.1)
    greedy = identities_kept(jl.tracking.GlobalNearestNeighbor(model, capacity=8), prior, truth[-1], z, valid)
    assert greedy < 52
    assert identities_kept(make_tracker(model), prior, truth[-1], z, valid) > 60


def test_answers_are_of_one_hypothesis(rng):
    tracker = make_tracker()
    z = jnp.asarray(rng.uniform(-3, 3, size=(12, 5, 2)), jnp.float32)
    state, history = run(tracker, tracker.init(no_targets()), jnp.ones(12), z, jnp.ones((12, 5), bool))
    assert bool(jnp.all(history.infos.ok))
    for t in range(12):
        at = jax.tree.map(lambda leaf, t=t: leaf[t], history.states)
        weights = np.exp(at.log_weights)
        assert weights.sum() == pytest.approx(1.0, rel=1e-4)
        member = np.asarray(at.membership())
        present = weights > 0
        assert len({row.tobytes() for row in member[present]}) == present.sum()
        labels, paths = np.asarray(at.leaves.labels), np.asarray(at.paths)
        final = {}
        for row in member[present]:
            # One leaf of a tree, and no measurement twice.
            assert len(set(labels[row])) == row.sum() and np.all(labels[row] >= 0)
            taken = paths[row, 0][paths[row, 0] >= 0]
            assert len(set(taken)) == len(taken)
            for label, path in zip(labels[row], paths[row, -1], strict=True):
                assert final.setdefault(label, path) == path
        assert np.all(np.asarray(at.existence()) <= 1.0)


@pytest.mark.slow
def test_nothing_measured_and_full_tables(rng):
    tracker = make_tracker(leaves=4, tracks=3)
    state = tracker.init(no_targets())
    empty, info = update(tracker, state, jnp.full((5, 2), jnp.nan), jnp.ones(5, bool))
    assert bool(info.ok) and float(info.count) == 0.0 and not bool(tracker.extract(empty).valid.any())
    assert float(info.log_likelihood) == pytest.approx(-1.01, rel=1e-5)
    z = jnp.asarray(rng.uniform(-50, 50, size=(5, 2)), jnp.float32)
    full, info = update(tracker, state, z, jnp.ones(5, bool))
    assert bool(info.ok) and int(info.crowded) >= 2 and int(jnp.sum(full.members >= 0)) == 3
    with pytest.raises(ValueError, match="beam"):
        make_tracker(beam=2)
    with pytest.raises(ValueError, match="3 tracks"):
        tracker.init(jl.beliefs.Mixture.empty(4, jnp.zeros(4)))


def test_one_certain_track_is_a_kalman_filter():
    tracker = make_tracker(make_model(clutter=1e-8, birth=1e-8, detection=0.999))
    z = jnp.array([[0.0, 0.0], [1.1, 0.4], [2.0, 1.1], [2.9, 1.6]])
    prior = jl.beliefs.Mixture(jnp.ones(1), jnp.zeros((1, 4)), jnp.eye(4)[None])
    state, _ = run(tracker, tracker.init(prior), jnp.ones(4), z[:, None], jnp.ones((4, 1), bool))
    filt = tracker.model.filter
    alone, _ = run(filt, filt.init(jl.beliefs.Gaussian(jnp.zeros(4), jnp.eye(4))), jnp.ones(4), z, jnp.ones(4, bool))
    found = tracker.extract(state)
    assert found.labels[found.valid].tolist() == [0]
    np.testing.assert_allclose(found.means[found.valid][0], alone.mean, atol=1e-5)
    assert tracks.NO_LABEL in found.labels.tolist()
