"""The CPHD filter against plain NumPy with explicit symmetric functions; the spooky effect of both."""  # T-64, T-76

import math
from itertools import combinations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import binom, multivariate_normal, poisson

import jaxloc as jl
from jaxloc.tracking import cphd

VOLUME, LARGEST = 400.0, 8
H = np.eye(2, 4)


def make(detection=0.8, rate=2.0, dtype=jnp.float64, largest=LARGEST, **options):
    motion = jl.filters.LinearMotion(jnp.eye(4, dtype=dtype), 0.1 * jnp.eye(4, dtype=dtype))
    filt = jl.filters.KalmanFilter(motion, jl.filters.LinearSensor(jnp.eye(2, 4, dtype=dtype), jnp.eye(2, dtype=dtype)))
    born = jl.beliefs.Mixture(jnp.array([0.2], dtype), jnp.zeros((1, 4), dtype), 4.0 * jnp.eye(4, dtype=dtype)[None])
    model = jl.tracking.TargetModel(
        filt,
        detection=jnp.asarray(detection, dtype),
        survival=jnp.asarray(0.9, dtype),
        clutter=jl.tracking.UniformClutter(jnp.asarray(rate, dtype), jnp.asarray(VOLUME, dtype)),
        birth=jl.tracking.StaticBirth(born),
    )
    options = {
        "capacity": 12,
        "candidates": 40,
        "prune": 0.0,
        "closeness": jl.beliefs.MahalanobisDistance(0.0),
    } | options
    return jl.tracking.GmCphd(jl.tracking.GmPhd(model, **options), max_targets=largest)


def symmetric(values, order):
    return sum(math.prod(chosen) for chosen in combinations(values, order))


def upsilon(u, n, values, missed, mass, clutter):
    """Vo, Vo and Cantoni 2007, eq. 20, without the constant factor of clutter; `missed`, `mass` are inner products."""
    total = 0.0
    for j in range(min(len(values), n - u) + 1):
        factor = math.factorial(len(values) - j) * clutter[len(values) - j] * math.perm(n, j + u)
        total += factor * missed ** (n - j - u) / mass**n * symmetric(values, j)
    return total


def numpy_update(weights, means, covariances, cardinality, measurements, detection, rate):
    """Weights of missed components and of pairs, the cardinality, and the likelihood."""
    clutter = poisson.pmf(np.arange(20), rate)
    density = np.array(
        [
            [multivariate_normal.pdf(z, H @ m, H @ P @ H.T + np.eye(2)) for z in measurements]
            for m, P in zip(means, covariances, strict=True)
        ]
    ).reshape(len(weights), -1)
    ratios = VOLUME * detection * weights @ density
    missed, mass = (1 - detection) * weights.sum(), weights.sum()

    def inner(u, values):
        return sum(p * upsilon(u, n, values, missed, mass, clutter) for n, p in enumerate(cardinality))

    whole = inner(0, ratios)
    undetected = inner(1, ratios) / whole * (1 - detection) * weights
    alone = [inner(1, np.delete(ratios, j)) / whole for j in range(len(measurements))]
    pairs = VOLUME * detection * weights[:, None] * density * np.array(alone)[None]
    posterior = [p * upsilon(0, n, ratios, missed, mass, clutter) / whole for n, p in enumerate(cardinality)]
    return undetected, pairs, np.array(posterior), np.log(whole) - len(measurements) * np.log(VOLUME)


@eqx.filter_jit
def update(tracker, state, measurements, valid):
    return tracker.update(state, measurements, valid)


@eqx.filter_jit
def advance(tracker, state, measurements, valid):
    return tracker.update(tracker.predict(state, None), measurements, valid)


@pytest.mark.usefixtures("x64")
def test_update_is_numpys():
    rng, tracker = np.random.default_rng(0), make()
    for count in (4, 0, 2):
        weights, means = rng.uniform(0.2, 1.2, 3), rng.normal(scale=3.0, size=(3, 4))
        roots = rng.normal(size=(3, 4, 4))
        covariances = roots @ roots.swapaxes(-1, -2) + np.eye(4)
        cardinality = rng.dirichlet(np.ones(LARGEST + 1))
        z = rng.normal(scale=3.0, size=(4, 2))
        mixture = jl.beliefs.Mixture(*map(jnp.asarray, (weights, means, covariances)))
        start = tracker.init(mixture)
        state = cphd.CphdState(start.mixture, jnp.asarray(cardinality), start.step, start.num_labels)
        after, info = update(tracker, state, jnp.asarray(z), jnp.arange(4) < count)
        expected = numpy_update(weights, means, covariances, cardinality, z[:count], 0.8, 2.0)
        np.testing.assert_allclose(after.cardinality, expected[2], atol=1e-9)
        everything = np.sort(np.concatenate([expected[0], expected[1].ravel()]))[::-1]
        found = np.asarray(after.mixture.weights)
        kept = min(len(found), len(everything))
        np.testing.assert_allclose(found[:kept], everything[:kept], atol=1e-9)
        assert float(info.log_likelihood) == pytest.approx(expected[3], abs=1e-9)
        assert float(info.count) == pytest.approx(expected[2] @ np.arange(LARGEST + 1), abs=1e-9)
        assert expected[0].sum() + expected[1].sum() == pytest.approx(float(info.count), abs=1e-9)


@pytest.mark.slow
@pytest.mark.usefixtures("x64")
def test_prediction_is_thinned_and_born(rng):
    tracker = make()
    cardinality = rng.dirichlet(np.ones(LARGEST + 1))
    start = tracker.init(jl.beliefs.Mixture.empty(1, jnp.zeros(4)))
    assert start.cardinality.tolist() == [1.0] + [0.0] * LARGEST
    state = cphd.CphdState(start.mixture, jnp.asarray(cardinality), start.step, start.num_labels)
    found = tracker.predict(state, None)
    numbers = np.arange(LARGEST + 1)
    thinned = sum(p * binom.pmf(numbers, n, 0.9) for n, p in enumerate(cardinality))
    np.testing.assert_allclose(cphd.survive(jnp.asarray(cardinality), jnp.asarray(0.9)), thinned, atol=1e-12)
    born = np.convolve(thinned, poisson.pmf(numbers, 0.2))[: LARGEST + 1]
    np.testing.assert_allclose(found.cardinality, born / born.sum(), atol=1e-7)
    assert float(found.mixture.mass) == pytest.approx(0.2)


@pytest.mark.parametrize("survival", [0.0, 1.0])
@pytest.mark.usefixtures("x64")
def test_certain_survival_and_death(survival):
    before = jnp.array([0.1, 0.2, 0.7])
    expected = before if survival else jnp.array([1.0, 0.0, 0.0])
    np.testing.assert_allclose(cphd.survive(before, jnp.asarray(survival)), expected, atol=1e-12)


@pytest.mark.usefixtures("x64")
def test_symmetric_functions_are_sums_over_subsets(rng):
    values = np.concatenate([rng.uniform(0.0, 3.0, 5), [0.0]])
    logs = jnp.log(jnp.asarray(values))
    found = np.exp(cphd.symmetric_functions(logs, 7))
    np.testing.assert_allclose(found, [symmetric(values, j) for j in range(7)] + [0.0], atol=1e-12)
    slope = jax.grad(lambda logs: cphd.symmetric_functions(logs, 2)[2])(logs)
    assert bool(jnp.all(jnp.isfinite(slope)))


@pytest.mark.slow
@pytest.mark.usefixtures("x64")
def test_spooky_effect():  # T-76
    """Two targets a kilometer apart, one of which is missed."""
    tracker = make(detection=0.9, rate=1.0)
    means = jnp.array([[0.0, 0.0, 0.0, 0.0], [1000.0, 0.0, 0.0, 0.0]])
    mixture = jl.beliefs.Mixture(jnp.ones(2), means, jnp.stack([jnp.eye(4)] * 2), jnp.arange(2, dtype=jnp.int32))
    start = tracker.init(mixture)
    exactly_two = jnp.zeros(LARGEST + 1).at[2].set(1.0)
    state = cphd.CphdState(start.mixture, exactly_two, start.step, start.num_labels)
    z = jnp.array([[0.5, 0.0]])

    def near(mixture, place):
        return float(jnp.sum(jnp.where(jnp.abs(mixture.means[:, 0] - place) < 50.0, mixture.weights, 0.0)))

    phd_after, _ = tracker.phd.update(tracker.phd.init(mixture), z, jnp.ones(1, bool))
    assert near(phd_after.mixture, 1000.0) == pytest.approx(0.1, abs=1e-12)
    after, info = update(tracker, state, z, jnp.ones(1, bool))
    expected = numpy_update(
        np.ones(2), np.asarray(means), np.stack([np.eye(4)] * 2), np.asarray(exactly_two), np.asarray(z), 0.9, 1.0
    )
    assert float(info.count) == pytest.approx(2.0, abs=1e-9)
    # The number of targets is kept. Half of what should be at the missed one is given to the one that was measured.
    assert near(after.mixture, 1000.0) == pytest.approx(expected[0][1], abs=1e-9)
    assert 0.4 < near(after.mixture, 1000.0) < 0.6 and near(after.mixture, 0.0) > 1.4


@pytest.mark.slow
def test_no_detections_padding_and_nonfinite_values():
    tracker = make(dtype=jnp.float32, rate=1.0)
    mixture = jl.beliefs.Mixture(jnp.array([0.9]), jnp.zeros((1, 4)), jnp.eye(4)[None])
    state = tracker.init(mixture)
    found = []
    for z, valid in (
        (jnp.zeros((0, 2)), jnp.zeros(0, bool)),
        (jnp.zeros((4, 2)), jnp.zeros(4, bool)),
        (jnp.full((4, 2), jnp.nan), jnp.ones(4, bool)),
    ):
        after, info = advance(tracker, state, z, valid)
        assert bool(info.ok)
        found.append((after.cardinality, info.count, info.log_likelihood))
    for other in found[1:]:
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), found[0], other)


def test_births_with_measurements_are_an_error():
    model = make(dtype=jnp.float32).phd.model
    birth = jl.tracking.PointBirth(0.1, VOLUME, jnp.eye(2), jnp.ones(2))
    model = eqx.tree_at(lambda m: m.birth, model, birth)
    with pytest.raises(ValueError, match="needs births at known places"):
        jl.tracking.GmCphd(jl.tracking.GmPhd(model))


def test_targets_in_sight_are_counted_and_never_share_a_label():
    """Two targets that leave the place of birth together: as many are said as there are most probably."""
    rng = np.random.default_rng(6)
    tracker = make(detection=0.95, rate=2.0, dtype=jnp.float32, capacity=30, candidates=60, prune=1e-5)
    tracker = eqx.tree_at(lambda t: t.phd.closeness, tracker, jl.beliefs.MahalanobisDistance(4.0))
    times = np.arange(30.0)
    truth = np.stack([np.stack([0.3 * times, 0 * times], 1), np.stack([-0.3 * times, 0.2 * times], 1)], axis=1)
    z = np.concatenate([truth + 0.5 * rng.normal(size=truth.shape), rng.uniform(-10, 10, (30, 2, 2))], axis=1)
    valid = np.concatenate([rng.uniform(size=(30, 2)) < 0.95, np.ones((30, 2), bool)], axis=1)
    state = tracker.init(jl.beliefs.Mixture.empty(1, jnp.zeros(4)))
    _, history = jl.filters.run(
        tracker, state, None, jnp.asarray(z, jnp.float32), jnp.asarray(valid), keep=tracker.extract
    )
    counts = np.asarray(history.states.valid.sum(1))
    assert np.median(counts[8:]) == 2 and bool(jnp.all(history.infos.ok))
    np.testing.assert_allclose(history.infos.count[8:], 2.0, atol=1.2)
    for labels, there in zip(np.asarray(history.states.labels), np.asarray(history.states.valid), strict=True):
        assert len(set(labels[there])) == there.sum()


@pytest.mark.slow
@pytest.mark.usefixtures("x64")
def test_likelihood_has_the_gradient_of_finite_differences(rng):
    z, valid = jnp.asarray(rng.normal(scale=3.0, size=(4, 2))), jnp.ones(4, bool)
    mixture = jl.beliefs.Mixture(
        jnp.array([0.9, 0.6]), jnp.asarray(rng.normal(size=(2, 4))), jnp.stack([jnp.eye(4)] * 2)
    )

    def value(parameters):
        tracker = make(*parameters)
        state, info = tracker.update(tracker.init(mixture), z, valid)
        return info.log_likelihood + tracker.update(state, z[::-1] + 0.3, valid)[1].log_likelihood

    where = jnp.array([0.8, 2.0])
    program = jax.jit(jax.vmap(jax.value_and_grad(value)))
    values, gradients = program(
        where[None] + 1e-6 * jnp.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    )
    np.testing.assert_allclose(
        gradients[0], [(values[1] - values[2]) / 2e-6, (values[3] - values[4]) / 2e-6], rtol=1e-4
    )
