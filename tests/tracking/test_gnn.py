"""Global nearest neighbor against SciPy's assignment, with modes; and all trackers through one driver."""  # T-58

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

import jaxloc as jl
from jaxloc.filters import run
from jaxloc.tracking import tracks


def make_filter(intensity=0.1):
    motion = jl.filters.ConstantVelocity(intensity, axes=2)
    return jl.filters.KalmanFilter(motion, jl.filters.LinearSensor(jnp.eye(2, 4), jnp.eye(2)))


def make_model(filt=None, *, clutter=2.0, birth=0.05, detection=0.95):
    return jl.tracking.TargetModel(
        make_filter() if filt is None else filt,
        detection=detection,
        survival=0.99,
        clutter=jl.tracking.UniformClutter(clutter, 1e4),
        birth=jl.tracking.PointBirth(birth, 1e4, jnp.eye(2), jnp.full(2, 4.0)),
    )


@eqx.filter_jit
def update(tracker, state, z, valid):
    return tracker.update(state, z, valid)


def no_targets():
    return jl.beliefs.Mixture.empty(1, jnp.zeros(4))


@pytest.fixture(scope="module")
def scene():
    """Two targets that cross under an angle, among clutter, each missed now and then."""
    rng = np.random.default_rng(4)
    times = np.arange(40.0)
    truth = np.stack([np.stack([2 * times - 40, times - 20], 1), np.stack([2 * times - 40, 20 - times], 1)], axis=1)
    measurements, valid = np.zeros((40, 8, 2), np.float32), np.zeros((40, 8), bool)
    measurements[:, :2] = truth + rng.normal(size=truth.shape)
    valid[:, :2] = rng.uniform(size=(40, 2)) < 0.95
    measurements[:, 2:] = rng.uniform(-50, 50, size=(40, 6, 2))
    valid[:, 2:] = np.arange(6)[None] < np.minimum(rng.poisson(2.0, size=(40, 1)), 6)
    order = np.argsort(rng.uniform(size=(40, 8)), axis=1)
    measurements, valid = np.take_along_axis(measurements, order[..., None], 1), np.take_along_axis(valid, order, 1)
    return jnp.asarray(truth, jnp.float32), jnp.asarray(measurements), jnp.asarray(valid)


def trackers():
    model = make_model()
    return {
        "gnn": jl.tracking.GlobalNearestNeighbor(model, capacity=16),
        "gnn counts": jl.tracking.GlobalNearestNeighbor(model, capacity=16, logic=jl.tracking.HistoryLogic(3, 5, 3)),
        "pda": jl.tracking.ProbabilisticDataAssociation(model, capacity=16),
        "jpda": jl.tracking.JointProbabilisticDataAssociation(model, capacity=16),
        "jpda exact": jl.tracking.JointProbabilisticDataAssociation(model, capacity=16, marginals=jl.tracking.Exact()),
        "mht": jl.tracking.MultipleHypothesisTracker(model, leaves=60, tracks=12, hypotheses=12, beam=24),
        "phd": jl.tracking.GmPhd(model, capacity=40),
    }


@pytest.mark.slow
@pytest.mark.parametrize("name", trackers())
def test_all_trackers_through_one_driver(name, scene):  # T-65
    truth, measurements, valid = scene
    tracker = trackers()[name]
    state, history = run(tracker, tracker.init(no_targets()), jnp.ones(40), measurements, valid, keep=tracker.extract)
    assert bool(jnp.all(history.infos.ok)) and bool(jnp.all(jnp.isfinite(history.infos.log_likelihood)))
    assert name in ("pda", "mht", "phd") or int(jnp.max(history.infos.crowded)) == 0
    found, there = history.states, jnp.ones(2, bool)
    # Confirmed within a few scans; Kalman filters of tracks that are known would be off by about 1.
    if name == "pda":
        # Alone, several tracks of one target do not know of each other; each target has one.
        apart = jnp.linalg.norm(truth[:, :, None, :] - found.means[:, None, :, :2], axis=-1)
        distances = jnp.min(jnp.where(found.valid[:, None, :], apart, 20.0), axis=2)
    else:
        distances = jax.vmap(lambda x, y, v: jl.evaluation.targets.ospa(x, there, y, v, cutoff=20.0).distance)(
            truth, found.means[..., :2], found.valid
        )
    assert float(jnp.mean(distances[8:])) < (6.0 if name == "phd" else 3.0)


def test_one_scan_is_scipys_assignment(rng):
    model = make_model()
    tracker = jl.tracking.GlobalNearestNeighbor(model, capacity=6, gate=None)
    means = jnp.asarray(np.pad(rng.normal(scale=4.0, size=(6, 2)), ((0, 0), (0, 2))), jnp.float32)
    prior = jl.beliefs.Mixture(jnp.full(6, 0.9), means, jnp.stack([jnp.eye(4)] * 6))
    z = jnp.asarray(rng.normal(scale=4.0, size=(8, 2)), jnp.float32)
    valid = jnp.arange(8) < 5
    state = tracker.init(prior)
    after, info = update(tracker, state, z, valid)
    assert bool(info.ok)

    delta = np.asarray(z)[None, :5] - np.asarray(means)[:, None, :2]
    likelihood = np.exp(-0.25 * (delta**2).sum(-1)) / (4 * np.pi)
    false = 2.05 / 1e4
    costs = np.concatenate([-np.log(0.9 * 0.95 * likelihood / false), np.full((6, 6), 1e6)], axis=1)
    costs[np.arange(6), 5 + np.arange(6)] = -np.log(1 - 0.9 * 0.95)
    rows, columns = linear_sum_assignment(costs)
    best = -costs[rows, columns].sum()
    expected = best + 5 * np.log(false) - 2.05
    assert float(info.log_likelihood) == pytest.approx(expected, rel=1e-4)
    by_label = {int(label): k for k, label in enumerate(after.labels)}
    for row, column in zip(rows, columns, strict=True):
        mean = np.asarray(means)[row, :2] + (0.5 * delta[row, column] if column < 5 else 0.0)
        slot = by_label[row]
        np.testing.assert_allclose(after.means()[slot, :2], mean, atol=1e-4)
        odds = 0.9 * 0.95 * likelihood[row, column] / false if column < 5 else 0.0
        existence = (0.9 * 0.05 + odds) / (1 - 0.9 * 0.95 + odds)
        assert float(after.existence[slot]) == pytest.approx(existence, rel=1e-4)


@pytest.mark.slow
def test_modes_inside_tracks():  # T-6
    steady, agile = make_filter(0.001), make_filter(10.0)
    modes = jl.filters.InteractingMultipleModel((steady, agile), jnp.array([[0.95, 0.05], [0.1, 0.9]]))
    tracker = jl.tracking.GlobalNearestNeighbor(make_model(modes), capacity=8)
    times = np.arange(24.0)
    turn = np.where(times < 12, 0.0, times - 12)
    path = np.stack([2 * times, 6 * turn], axis=1)
    places = jnp.asarray(np.stack([path, -path - 20.0], axis=1), jnp.float32)
    state, history = run(
        tracker, tracker.init(no_targets()), jnp.ones(24), places, jnp.ones((24, 2), bool), keep=lambda s: s
    )
    found = tracker.extract(state)
    assert found.labels[found.valid].tolist() == [0, 1]
    np.testing.assert_allclose(found.means[:2, :2], places[-1], atol=1.0)
    wild_share = history.states.states.probabilities[:, 0, 1]
    assert float(wild_share[11]) < 0.3 and float(jnp.max(wild_share[12:15])) > 0.8
    # One track alone is the bank of filters itself.
    prior = jl.beliefs.Mixture(jnp.ones(1), jnp.zeros((1, 4)), jnp.eye(4)[None])
    opened = tracker.init(prior)
    z = jnp.array([[0.5, 0.5]])
    after, _ = update(tracker, opened, z, jnp.array([True]))
    alone, _ = update(modes, modes.init(jl.beliefs.Gaussian(jnp.zeros(4), jnp.eye(4))), z[0], jnp.array(True))
    np.testing.assert_allclose(tracker.extract(after).means[0], alone.combined().mean, atol=1e-6)
    with pytest.raises(TypeError, match="GlobalNearestNeighbor takes"):
        jl.tracking.ProbabilisticDataAssociation(make_model(modes))


@pytest.mark.slow
def test_nothing_measured_and_nonfinite_values():
    tracker = jl.tracking.GlobalNearestNeighbor(make_model(), capacity=4)
    prior = jl.beliefs.Mixture(jnp.array([0.99, 0.5]), jnp.zeros((2, 4)), jnp.stack([jnp.eye(4)] * 2))
    state = tracker.init(prior)
    empty, info = update(tracker, state, jnp.zeros((3, 2)), jnp.zeros(3, bool))
    bad, bad_info = update(tracker, state, jnp.full((3, 2), jnp.nan), jnp.ones(3, bool))
    for a, b in zip(jax.tree.leaves((empty, info)), jax.tree.leaves((bad, bad_info)), strict=True):
        np.testing.assert_array_equal(a, b)
    assert bool(info.ok) and bool(jnp.all(jnp.isfinite(empty.existence)))
    np.testing.assert_allclose(empty.existence[:2], tracks.miss(state.existence[:2], jnp.full(2, 0.95)), rtol=1e-5)
    expected = -2.05 + np.sum(np.log(1 - 0.95 * np.array([0.99, 0.5])))
    assert float(info.log_likelihood) == pytest.approx(expected, rel=1e-4)


def test_full_table_says_so(rng):
    tracker = jl.tracking.GlobalNearestNeighbor(make_model(), capacity=2)
    z = jnp.asarray(rng.uniform(-50, 50, size=(8, 2)), jnp.float32)
    state, info = update(tracker, tracker.init(no_targets()), z, jnp.ones(8, bool))
    assert int(info.crowded) == 6 and int(jnp.sum(state.valid)) == 2


@pytest.mark.slow
def test_batches_are_loops(scene):
    _, measurements, valid = scene
    tracker = jl.tracking.GlobalNearestNeighbor(make_model(), capacity=16)
    start = tracker.init(no_targets())

    def likelihood(z, v):
        return run(tracker, start, jnp.ones(10), z, v)[1].infos.log_likelihood

    z, v = measurements.reshape(4, 10, 8, 2), valid.reshape(4, 10, 8)
    together = jax.jit(jax.vmap(likelihood))(z, v)
    np.testing.assert_allclose(together[1], likelihood(z[1], v[1]), rtol=1e-4)
    np.testing.assert_allclose(together[3], likelihood(z[3], v[3]), rtol=1e-4)
