"""The GM-PHD filter against Stone Soup, a plain NumPy one, and what its equations say."""  # T-45, T-63, T-75

import datetime

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

import jaxloc as jl
from jaxloc.tracking import gmphd

F = np.eye(4) + np.eye(4, k=2)
H = np.eye(2, 4)


def cv_noise(q):
    return q * np.kron(np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]]), np.eye(2))


def static_birth(dtype=jnp.float32, weights=(0.1, 0.1)):
    means = jnp.array([[-20.0, 0.0, 0.0, 0.0], [20.0, 10.0, 0.0, 0.0]], dtype)
    covariances = jnp.stack([10.0 * jnp.eye(4, dtype=dtype)] * 2)
    return jl.tracking.StaticBirth(jl.beliefs.Mixture(jnp.array(weights, dtype), means, covariances))


def make_filter(kind="linear", q=0.5, r=1.0, dtype=jnp.float32):
    motion = jl.filters.LinearMotion(jnp.asarray(F, dtype), q * jnp.asarray(cv_noise(1.0), dtype))
    sensor = jl.filters.LinearSensor(jnp.asarray(H, dtype), r**2 * jnp.eye(2, dtype=dtype))
    if kind == "linear":
        return jl.filters.KalmanFilter(motion, sensor)
    if kind == "extended":
        return jl.filters.ExtendedKalmanFilter(motion, sensor)
    return jl.filters.SigmaPointFilter(motion, sensor, jl.filters.Unscented(alpha=1.0, beta=2.0, kappa=2.0))


def make_phd(
    filt=None, *, detection=0.9, survival=0.95, rate=4.0, birth=None, dtype=jnp.float32, capacity=24, **options
):
    model = jl.tracking.TargetModel(
        make_filter(dtype=dtype) if filt is None else filt,
        detection=jnp.asarray(detection, dtype),
        survival=jnp.asarray(survival, dtype),
        clutter=jl.tracking.UniformClutter(jnp.asarray(rate, dtype), jnp.asarray(1e4, dtype)),
        birth=static_birth(dtype) if birth is None else birth,
    )
    return jl.tracking.GmPhd(model, capacity=capacity, **options)


def random_mixtures(rng, count, size):
    """Weights, means, and covariances between which nothing is alike."""
    roots = rng.normal(size=(count, size, 4, 4))
    covariances = roots @ roots.swapaxes(-1, -2) + 0.5 * np.eye(4)
    return rng.uniform(0.05, 1.2, size=(count, size)), rng.normal(scale=6.0, size=(count, size, 4)), covariances


def numpy_update(weights, means, covariances, measurements, detection, clutter, born=0.0):
    """Missed components, then those of each measurement; clutter and births as intensities.

    References: Vo and Ma 2006, eqs. 28-34.
    """
    parts = [((1 - detection) * w, m, P) for w, m, P in zip(weights, means, covariances, strict=True)]
    log_likelihood = -detection * np.sum(weights)
    for z in measurements:
        explained = []
        for w, m, P in zip(weights, means, covariances, strict=True):
            S = H @ P @ H.T + np.eye(2)
            K = P @ H.T @ np.linalg.inv(S)
            joseph = (np.eye(4) - K @ H) @ P @ (np.eye(4) - K @ H).T + K @ K.T
            density = multivariate_normal.pdf(z, H @ m, S)
            explained.append((detection * w * density, m + K @ (z - H @ m), joseph))
        total = clutter + born + sum(part[0] for part in explained)
        log_likelihood += np.log(total)
        parts += [(w / total, m, P) for w, m, P in explained]
    return parts, log_likelihood


def assert_same(mixture, parts, tolerance):
    """As sets: in the order of their weights."""
    parts = sorted(parts, key=lambda part: -part[0])
    weights = np.asarray(mixture.weights)
    assert len(parts) == len(weights)
    np.testing.assert_allclose(weights, [part[0] for part in parts], rtol=0, atol=tolerance)
    for k, (w, m, P) in enumerate(parts):
        if w > 1e-12:
            np.testing.assert_allclose(mixture.means[k], m, rtol=0, atol=tolerance)
            np.testing.assert_allclose(mixture.covariances[k], P, rtol=0, atol=tolerance)


@eqx.filter_jit
@eqx.filter_vmap(in_axes=(eqx.if_array(0), eqx.if_array(0), 0, None))
def step_many(phd, mixture, measurements, valid):
    return gmphd.update(gmphd.predict(mixture, phd), measurements, valid, phd)


@pytest.fixture(scope="module")
def hundred():
    """A hundred random mixtures, each with its own probabilities, in float64, predicted and updated."""
    rng = np.random.default_rng(1)
    weights, means, covariances = random_mixtures(rng, 100, 4)
    measurements = rng.normal(scale=6.0, size=(100, 4, 2))
    detection, survival, rate = rng.uniform(0.5, 0.99, 100), rng.uniform(0.8, 0.99, 100), rng.uniform(1.0, 30.0, 100)
    with jax.enable_x64(True):
        phds = eqx.filter_vmap(lambda d, s, r: make_phd(detection=d, survival=s, rate=r, dtype=jnp.float64))(
            *map(jnp.asarray, (detection, survival, rate))
        )
        mixtures = jl.beliefs.Mixture(*map(jnp.asarray, (weights, means, covariances)), jnp.zeros((100, 4), jnp.int32))
        after, evidence = step_many(phds, mixtures, jnp.asarray(measurements), jnp.ones(4, bool))
        after, evidence = jax.tree.map(np.asarray, (after, evidence))
    return (weights, means, covariances, measurements, detection, survival, rate), after, evidence


def test_hundred_mixtures_are_stone_soups(hundred):  # T-63
    pytest.importorskip("stonesoup")
    from stonesoup.hypothesiser.distance import DistanceHypothesiser
    from stonesoup.hypothesiser.gaussianmixture import GaussianMixtureHypothesiser
    from stonesoup.measures import Mahalanobis
    from stonesoup.models.measurement.linear import LinearGaussian
    from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
    from stonesoup.predictor.kalman import KalmanPredictor
    from stonesoup.types.detection import Detection
    from stonesoup.types.state import TaggedWeightedGaussianState
    from stonesoup.updater.kalman import KalmanUpdater
    from stonesoup.updater.pointprocess import PHDUpdater

    then, now = datetime.datetime(2024, 1, 1), datetime.datetime(2024, 1, 1, 0, 0, 1)
    predictor = KalmanPredictor(CombinedLinearGaussianTransitionModel([ConstantVelocity(0.5)] * 2))
    sensor = LinearGaussian(4, (0, 2), np.eye(2))
    kalman = KalmanUpdater(sensor)
    # All pairs (it gates otherwise), and births like other components: it gives those with the tag no missed term.
    single = DistanceHypothesiser(predictor, kalman, Mahalanobis(), missed_distance=1e9, include_all=True)
    hypothesiser = GaussianMixtureHypothesiser(single, order_by_detection=True)
    swap = np.array([0, 2, 1, 3])  # its states are (x, vx, y, vy)
    birth = static_birth().intensity

    def component(weight, mean, covariance, time):
        return TaggedWeightedGaussianState(
            mean[swap].reshape(-1, 1), covariance[np.ix_(swap, swap)], timestamp=time, weight=weight, tag="one"
        )

    data, after, _ = hundred
    for number, (w, m, P, z, detection, survival, rate) in enumerate(zip(*data, strict=True)):
        components = []
        for k in range(4):
            predicted = predictor.predict(component(w[k], m[k], P[k], then), timestamp=now)
            mean = np.asarray(predicted.mean, float).ravel()
            components.append(component(w[k], mean[swap], np.asarray(predicted.covar)[np.ix_(swap, swap)], now))
        for mean in np.asarray(birth.means, float):  # its updater multiplies every weight by the survival
            components.append(component(0.1 / survival, mean, 10.0 * np.eye(4), now))
        updater = PHDUpdater(
            kalman, clutter_spatial_density=rate / 1e4, prob_detection=detection, prob_survival=survival
        )
        detections = [Detection(row.reshape(-1, 1), timestamp=now, measurement_model=sensor) for row in z]
        found = updater.update(hypothesiser.hypothesise(components, detections, now))
        parts = [
            (float(c.weight), np.asarray(c.mean, float).ravel()[swap], np.asarray(c.covar, float)[np.ix_(swap, swap)])
            for c in found.components
        ]
        assert_same(jax.tree.map(lambda leaf, n=number: leaf[n], after), parts, 1e-9)


def test_hundred_mixtures_are_numpys(hundred):  # T-75
    data, after, evidence = hundred
    birth = static_birth().intensity
    for number, (w, m, P, z, detection, survival, rate) in enumerate(zip(*data, strict=True)):
        weights = np.concatenate([survival * w, [0.1, 0.1]])
        means = np.concatenate([m @ F.T, np.asarray(birth.means, float)])
        covariances = np.concatenate([F @ P @ F.T + cv_noise(0.5), [10.0 * np.eye(4)] * 2])
        parts, log_likelihood = numpy_update(weights, means, covariances, z, detection, rate / 1e4)
        assert_same(jax.tree.map(lambda leaf, n=number: leaf[n], after), parts, 1e-9)
        assert float(evidence.log_likelihood[number]) == pytest.approx(log_likelihood - rate, abs=1e-9)
        explained = np.sum([part[0] for part in parts[6:]])
        assert float(np.sum(evidence.clutter[number])) == pytest.approx(4 - explained, abs=1e-9)


@pytest.mark.usefixtures("x64")
def test_spawning_is_a_motion_of_each_component(rng):
    w, m, P = (part[0] for part in random_mixtures(rng, 1, 3))
    back = jl.filters.LinearMotion(-jnp.eye(4), jnp.diag(jnp.array([1.0, 2.0, 3.0, 4.0])))
    spawning = jl.tracking.Spawning(jnp.asarray(0.05), back)
    phd = make_phd(dtype=jnp.float64, spawning=spawning)
    mixture = jl.beliefs.Mixture(*map(jnp.asarray, (w, m, P)), jnp.array([4, 7, 2], jnp.int32))
    found = gmphd.predict(mixture, phd)
    np.testing.assert_allclose(found.weights, [*(0.95 * w), *(0.05 * w), 0.1, 0.1], atol=1e-12)
    np.testing.assert_allclose(found.means[3:6], -m, atol=1e-12)
    np.testing.assert_allclose(found.covariances[3:6], P + np.diag([1.0, 2.0, 3.0, 4.0]), atol=1e-9)
    assert found.labels.tolist() == [4, 7, 2, 8, 9, 10, 11, 12]


@eqx.filter_jit
def step(phd, state, measurements, valid):
    return phd.update(phd.predict(state, None), measurements, valid)


def some_state(phd, dtype=jnp.float32):
    means = jnp.array([[0.0, 0.0, 1.0, 0.0], [5.0, -5.0, 0.0, 1.0], [-8.0, 4.0, 0.0, 0.0]], dtype)
    covariances = jnp.stack([jnp.eye(4, dtype=dtype)] * 3)
    return phd.init(jl.beliefs.Mixture(jnp.array([0.9, 0.8, 0.3], dtype), means, covariances))


SEEN = np.array([[1.2, 0.3], [5.1, -3.8], [30.0, 30.0], [7.0, 7.0]])


def assert_trees_close(first, second, tolerance):
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=0, atol=tolerance), first, second)


@pytest.mark.parametrize("kind", ["extended", "unscented"])
@pytest.mark.usefixtures("x64")
def test_other_filters_equal_the_linear_one_on_linear_models(kind):
    found = []
    for name in ("linear", kind):
        phd = make_phd(make_filter(name, dtype=jnp.float64), dtype=jnp.float64)
        found.append(step(phd, some_state(phd, jnp.float64), jnp.asarray(SEEN), jnp.ones(4, bool)))
    assert_trees_close(*found, 1e-8)


def test_bad_numbers_and_padding_are_absent():
    phd = make_phd()
    state, z = some_state(phd), jnp.asarray(SEEN, jnp.float32)
    masked = step(phd, state, z, jnp.array([True, True, False, False]))
    bad = step(phd, state, z.at[2, 0].set(jnp.nan).at[3].set(jnp.inf), jnp.ones(4, bool))
    assert_trees_close(masked, bad, 0.0)
    short = step(phd, state, z[:2], jnp.ones(2, bool))
    assert_trees_close(masked[0].mixture.weights, short[0].mixture.weights, 1e-6)
    assert_trees_close(masked[0].mixture.means, short[0].mixture.means, 1e-5)
    assert_trees_close(masked[1], short[1], 1e-5)


@pytest.mark.parametrize("shape", [(0, 2), (4, 2)], ids=["no room", "none valid"])
def test_no_detections_leave_the_missed(shape):
    phd = make_phd()
    state = some_state(phd)
    after, info = step(phd, state, jnp.zeros(shape), jnp.zeros(shape[0], bool))
    expected = 0.1 * (0.95 * 2.0 + 0.2)
    assert bool(info.ok) and float(info.count) == pytest.approx(expected, rel=1e-5)
    assert float(info.log_likelihood) == pytest.approx(-(9 * expected + 4.0), rel=1e-5)
    assert float(jnp.max(after.mixture.weights)) == pytest.approx(0.1 * 0.95 * 0.9, rel=1e-5)


def test_what_finds_no_room_is_counted():
    """Both what merging leaves over, and what was too light to take part in it."""
    state = some_state(make_phd())
    z = jnp.asarray(np.random.default_rng(3).normal(scale=4.0, size=(12, 2)), jnp.float32)
    apart = jl.beliefs.MahalanobisDistance(0.0)
    everything = make_phd(capacity=200, closeness=apart)
    after, info = step(everything, everything.init(state.mixture), z, jnp.ones(12, bool))
    total = int(jnp.sum(after.mixture.valid))
    assert int(info.crowded) == 0 and total > 24
    for candidates in (None, 200):
        tight = make_phd(capacity=12, closeness=apart, candidates=candidates)
        small = tight.init(jl.beliefs.Mixture(*(leaf[:12] for leaf in jax.tree.leaves(state.mixture))))
        kept, info = step(tight, small, z, jnp.ones(12, bool))
        assert int(info.crowded) == total - 12
        np.testing.assert_allclose(kept.mixture.weights, after.mixture.weights[:12], atol=1e-6)


def test_too_large_a_prior_is_an_error():
    phd = make_phd(capacity=4)
    with pytest.raises(ValueError, match="keeps 4 components; the prior has 5"):
        phd.init(jl.beliefs.Mixture.empty(5, jnp.zeros(4)))


@pytest.mark.parametrize("gate", [None, 0.99])
def test_births_with_measurements_have_exact_weights(gate):
    birth = jl.tracking.PointBirth(0.2, 1e4, jnp.eye(2), jnp.full(2, 9.0))
    phd = make_phd(birth=birth, gate=gate, prune=0.0, closeness=jl.beliefs.MahalanobisDistance(0.0), capacity=40)
    mixture = some_state(phd).mixture.take(jnp.arange(3))
    z = jnp.asarray(SEEN, jnp.float32)
    predicted = gmphd.predict(mixture, phd)
    found, evidence = gmphd.update(predicted, z, jnp.ones(4, bool), phd, first_label=50)
    parts, log_likelihood = numpy_update(
        *(np.asarray(leaf, float) for leaf in (predicted.weights, predicted.means, predicted.covariances)),
        SEEN, 0.9, 4e-4, 0.2e-4,
    )  # fmt: skip
    explained = np.array([sum(part[0] for part in parts[3 + 3 * j : 6 + 3 * j]) for j in range(4)])
    expected = (1.0 - explained) * 0.2 / 4.2
    if gate is None:
        assert float(evidence.log_likelihood) == pytest.approx(log_likelihood - 4.2, abs=1e-3)
    else:  # those that a target may explain bear none
        expected[:2] = 0.0
    np.testing.assert_allclose(evidence.born, expected, rtol=2e-3, atol=1e-7)
    for j in np.flatnonzero(expected > 1e-3):
        slot = found.labels.tolist().index(50 + j)
        np.testing.assert_allclose(found.means[slot], [*SEEN[j], 0.0, 0.0], atol=1e-6)
        np.testing.assert_allclose(found.covariances[slot], np.diag([1.0, 1.0, 9.0, 9.0]), atol=1e-6)


def test_extraction_copies_heavy_components():  # T-82
    means = jnp.arange(20.0).reshape(5, 4)
    covariances = jnp.stack([jnp.eye(4)] * 5)
    labels = jnp.arange(5, dtype=jnp.int32)
    mixture = jl.beliefs.Mixture(jnp.array([2.3, 0.4, 0.51, 0.0, 1.0]), means, covariances, labels)
    found = gmphd.extract(mixture)
    assert found.labels[found.valid].tolist() == [0, 0, 2, 4]
    once = gmphd.extract(mixture, copies=False)
    assert once.labels[once.valid].tolist() == [0, 2, 4]
    np.testing.assert_allclose(once.means[once.valid], np.asarray(means)[[0, 2, 4]])


def crossing(rng, scans=40, rate=4.0, detection=0.9):
    """Two targets on crossing lines among clutter: measurements in random order."""
    times = np.arange(float(scans))
    truth = np.stack([np.stack([times - 20, 0.5 * (times - 20)], 1), np.stack([20 - times, times / 2], 1)], axis=1)
    truth += np.array([[0.0, 0.0], [0.0, 4.0]])
    room = 14
    z, valid = rng.uniform(-50, 50, (scans, room, 2)), np.zeros((scans, room), bool)
    z[:, :2] = truth + rng.normal(size=truth.shape)
    valid[:, :2] = rng.uniform(size=(scans, 2)) < detection
    valid[:, 2:] = np.arange(room - 2)[None] < rng.poisson(rate, (scans, 1))
    order = np.argsort(rng.uniform(size=valid.shape), axis=1)
    return truth, np.take_along_axis(z, order[..., None], 1), np.take_along_axis(valid, order, 1)


@pytest.fixture(scope="module")
def tracked():
    truth, z, valid = crossing(np.random.default_rng(5))
    birth = static_birth(weights=(0.05, 0.05))
    phd = make_phd(birth=birth, capacity=40, detection=0.9, survival=0.99)
    prior = jl.beliefs.Mixture.empty(1, jnp.zeros(4))
    args = phd.init(prior), None, jnp.asarray(z, jnp.float32), jnp.asarray(valid)
    state, history = jl.filters.run(phd, *args, keep=lambda state: (phd.extract(state), state.mixture))
    return truth, phd, args, state, history


def test_labels_stay_with_their_targets(tracked):  # T-82
    truth, _, _, _, history = tracked
    targets, mixtures = history.states
    assert bool(jnp.all(history.infos.ok)) and int(jnp.max(history.infos.crowded)) == 0
    seen = [[], []]
    for t in range(6, 40):
        valid = np.asarray(targets.valid[t])
        labels, means = np.asarray(targets.labels[t])[valid], np.asarray(targets.means[t])[valid, :2]
        assert len(set(labels)) == len(labels)
        for k in range(2):
            near = np.linalg.norm(means - truth[t, k], axis=1) if len(means) else np.array([np.inf])
            if near.min() < 4.0:
                seen[k].append(int(labels[near.argmin()]))
    assert min(map(len, seen)) > 26
    assert len(set(seen[0])) == len(set(seen[1])) == 1 and seen[0][0] != seen[1][0]
    heavy = np.asarray(mixtures.weights) > 0.5
    for labels, there in zip(np.asarray(mixtures.labels), heavy, strict=True):
        assert len(set(labels[there])) == there.sum()


def test_run_is_its_steps(tracked):
    _, phd, args, _, history = tracked
    last, copied = gmphd.run(jl.beliefs.Mixture.empty(1, jnp.zeros(4)), phd, *args[1:], copies=False)
    np.testing.assert_array_equal(copied.states.means, history.states[0].means)
    np.testing.assert_array_equal(last.weights, history.states[1].weights[-1])
    state = args[0]
    for t in range(4):
        state, info = step(phd, state, args[2][t], args[3][t])
    np.testing.assert_allclose(state.mixture.weights, history.states[1].weights[3], atol=1e-5)
    assert float(info.log_likelihood) == pytest.approx(float(history.infos.log_likelihood[3]), abs=1e-3)


def test_many_runs_at_once_are_a_loop(tracked):
    _, phd, (state, _, z, valid), _, history = tracked

    def one(z, valid):
        return jl.filters.run(phd, state, None, z, valid)[1].infos

    found = jax.jit(jax.vmap(one))(jnp.stack([z, z[::-1]]), jnp.stack([valid, valid[::-1]]))
    np.testing.assert_allclose(found.log_likelihood[0], history.infos.log_likelihood, atol=2e-3)
    np.testing.assert_allclose(found.count[0], history.infos.count, atol=2e-3)


@pytest.mark.parametrize("assumed", [2.0, 18.0])
def test_clutter_rate_is_found(assumed):
    rng = np.random.default_rng(8)
    z, valid = rng.uniform(-50, 50, (200, 14, 2)), np.arange(14)[None] < rng.poisson(5.0, (200, 1))
    phd = make_phd(rate=assumed, birth=static_birth(weights=(0.005, 0.005)), capacity=40, clutter_memory=50.0)
    state = phd.init(jl.beliefs.Mixture.empty(1, jnp.zeros(4)))
    state, _ = jl.filters.run(phd, state, None, jnp.asarray(z, jnp.float32), jnp.asarray(valid))
    recent = np.sum(valid * 0.98 ** np.arange(200)[::-1, None]) / np.sum(0.98 ** np.arange(200))
    assert float(state.clutter_scale) * assumed == pytest.approx(recent, rel=0.1)


def likelihood(parameters, z, valid):
    detection, rate, q, r = parameters
    filt = make_filter(q=q, r=r, dtype=jnp.float64)
    phd = make_phd(filt, detection=detection, rate=rate, dtype=jnp.float64, capacity=30, prune=1e-9)
    state = phd.init(jl.beliefs.Mixture.empty(1, jnp.zeros(4)))
    return jnp.sum(jl.filters.run(phd, state, None, z, valid)[1].infos.log_likelihood)


@pytest.mark.usefixtures("x64")
def test_likelihood_has_the_gradient_of_finite_differences():
    _, z, valid = crossing(np.random.default_rng(2), scans=12)
    z, valid = jnp.asarray(z), jnp.asarray(valid)
    value = jnp.array([0.85, 5.0, 0.7, 1.2])
    steps = 1e-6 * jnp.concatenate([jnp.zeros((1, 4)), jnp.eye(4), -jnp.eye(4)])
    program = jax.jit(jax.vmap(jax.value_and_grad(likelihood), in_axes=(0, None, None)))
    values, gradients = program(value[None, :] + steps, z, valid)
    for k, slope in enumerate(np.asarray(gradients[0])):
        ends = values[1 + k], values[5 + k]
        numeric = float(ends[0] - ends[1]) / 2e-6
        assert slope == pytest.approx(numeric, rel=1e-3) and abs(slope) > 1e-3, k


def test_gradient_is_finite_where_there_is_nothing():
    def cost(detection):
        phd = make_phd(detection=detection, gate=0.99)
        after, info = phd.update(
            phd.predict(phd.init(jl.beliefs.Mixture.empty(1, jnp.zeros(4))), None),
            jnp.full((3, 2), jnp.nan),
            jnp.ones(3, bool),
        )
        return info.log_likelihood + after.mixture.mass + jnp.sum(after.mixture.covariances)

    assert bool(jnp.isfinite(jax.jit(jax.grad(cost))(jnp.array(0.9))))


def test_published_scenario():  # T-74
    """Bounds far wider than those of the benchmark, which runs forty seeds."""
    scenario = jl.data.simulate.targets.LinearScenario(clutter_rate=10.0)
    model = jl.tracking.TargetModel(
        jl.filters.KalmanFilter(scenario.motion, scenario.sensor),
        detection=scenario.detection,
        survival=scenario.survival,
        clutter=jl.tracking.UniformClutter(scenario.clutter_rate, scenario.clutter_volume),
        birth=jl.tracking.StaticBirth(
            jl.beliefs.Mixture(scenario.birth_weights, scenario.birth_means, jnp.stack([scenario.birth_covariance] * 4))
        ),
    )
    phd = jl.tracking.GmPhd(model, capacity=60, gate=0.999)

    def one(key):
        drive = jl.data.simulate.targets.simulate_targets(scenario, key=key)
        prior = jl.beliefs.Mixture.empty(1, jnp.zeros(4))
        _, history = gmphd.run(prior, phd, None, drive.measurements, drive.valid)
        found = history.states
        distance = jax.vmap(lambda x, v, y, w: jl.evaluation.targets.ospa(x, v, y, w, cutoff=100.0).distance)
        return jnp.mean(distance(found.means[..., :2], found.valid, drive.truth[..., :2], drive.truth_valid))

    found = jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(0), 4))
    assert 11.0 < float(jnp.mean(found)) < 16.5
