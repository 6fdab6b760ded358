"""Prediction, weights and components of intensities against Stone Soup, a plain NumPy filter, and the equations."""

# T-45, T-63, T-75

import datetime

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

import jaxloc as jl
from jaxloc.tracking import intensity

F = np.eye(4) + np.eye(4, k=2)
H = np.eye(2, 4)


def cv_noise(q):
    return q * np.kron(np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]]), np.eye(2))


def static_birth(dtype=jnp.float32, weights=(0.1, 0.1)):
    means = jnp.array([[-20.0, 0.0, 0.0, 0.0], [20.0, 10.0, 0.0, 0.0]], dtype)
    covariances = jnp.stack([10.0 * jnp.eye(4, dtype=dtype)] * 2)
    return jl.tracking.StaticBirth(jl.beliefs.Mixture(jnp.array(weights, dtype), means, covariances))


def make_model(*, detection=0.9, survival=0.95, rate=4.0, birth=None, dtype=jnp.float32):
    motion = jl.filters.LinearMotion(jnp.asarray(F, dtype), jnp.asarray(cv_noise(0.5), dtype))
    sensor = jl.filters.LinearSensor(jnp.asarray(H, dtype), jnp.eye(2, dtype=dtype))
    return jl.tracking.TargetModel(
        jl.filters.KalmanFilter(motion, sensor),
        detection=jnp.asarray(detection, dtype),
        survival=jnp.asarray(survival, dtype),
        clutter=jl.tracking.UniformClutter(jnp.asarray(rate, dtype), jnp.asarray(1e4, dtype)),
        birth=static_birth(dtype) if birth is None else birth,
    )


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
def step_many(model, mixture, measurements, valid):
    predicted = intensity.predict(mixture, model, None, first_label=1)
    evidence = intensity.weigh(predicted, measurements, valid, model)
    every = predicted.capacity * (measurements.shape[0] + 1)
    return intensity.heaviest(predicted, measurements, evidence, model.birth, candidates=every, first_label=1), evidence


@pytest.fixture(scope="module")
def hundred():
    """A hundred random mixtures, each with its own probabilities, in float64, predicted and updated."""
    rng = np.random.default_rng(1)
    weights, means, covariances = random_mixtures(rng, 100, 4)
    measurements = rng.normal(scale=6.0, size=(100, 4, 2))
    detection, survival, rate = rng.uniform(0.5, 0.99, 100), rng.uniform(0.8, 0.99, 100), rng.uniform(1.0, 30.0, 100)
    with jax.enable_x64(True):
        models = eqx.filter_vmap(lambda d, s, r: make_model(detection=d, survival=s, rate=r, dtype=jnp.float64))(
            *map(jnp.asarray, (detection, survival, rate))
        )
        mixtures = jl.beliefs.Mixture(*map(jnp.asarray, (weights, means, covariances)), jnp.zeros((100, 4), jnp.int32))
        after, evidence = step_many(models, mixtures, jnp.asarray(measurements), jnp.ones(4, bool))
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


@pytest.mark.slow
@pytest.mark.usefixtures("x64")
def test_spawning_is_a_motion_of_each_component(rng):
    w, m, P = (part[0] for part in random_mixtures(rng, 1, 3))
    back = jl.filters.LinearMotion(-jnp.eye(4), jnp.diag(jnp.array([1.0, 2.0, 3.0, 4.0])))
    spawning = jl.tracking.Spawning(jnp.asarray(0.05), back)
    mixture = jl.beliefs.Mixture(*map(jnp.asarray, (w, m, P)), jnp.array([4, 7, 2], jnp.int32))
    found = intensity.predict(mixture, make_model(dtype=jnp.float64), None, first_label=8, spawning=spawning)
    np.testing.assert_allclose(found.weights, [*(0.95 * w), *(0.05 * w), 0.1, 0.1], atol=1e-12)
    np.testing.assert_allclose(found.means[3:6], -m, atol=1e-12)
    np.testing.assert_allclose(found.covariances[3:6], P + np.diag([1.0, 2.0, 3.0, 4.0]), atol=1e-9)
    assert found.labels.tolist() == [4, 7, 2, 8, 9, 10, 11, 12]


SEEN = np.array([[1.2, 0.3], [5.1, -3.8], [30.0, 30.0], [7.0, 7.0]])


@pytest.mark.slow
@pytest.mark.parametrize("gate", [None, 0.99])
def test_births_with_measurements_have_exact_weights(gate):
    birth = jl.tracking.PointBirth(0.2, 1e4, jnp.eye(2), jnp.full(2, 9.0))
    model = make_model(birth=birth)
    means = jnp.array([[0.0, 0.0, 1.0, 0.0], [5.0, -5.0, 0.0, 1.0], [-8.0, 4.0, 0.0, 0.0]])
    mixture = jl.beliefs.Mixture(jnp.array([0.9, 0.8, 0.3]), means, jnp.stack([jnp.eye(4)] * 3))
    z = jnp.asarray(SEEN, jnp.float32)
    predicted = intensity.predict(mixture, model, None, first_label=3)
    evidence = intensity.weigh(predicted, z, jnp.ones(4, bool), model, gate=gate)
    found = intensity.heaviest(predicted, z, evidence, birth, candidates=80, first_label=50)
    parts, log_likelihood = numpy_update(
        *(np.asarray(leaf, float) for leaf in (predicted.weights, predicted.means, predicted.covariances)),
        SEEN, 0.9, 4e-4, 0.2e-4,
    )  # fmt: skip
    explained = np.array([sum(part[0] for part in parts[3 + 3 * j : 6 + 3 * j]) for j in range(4)])
    expected = (1.0 - explained) * 0.2 / 4.2
    if gate is None:
        assert float(evidence.log_likelihood) == pytest.approx(log_likelihood - 4.2, abs=1e-3)
    else:  # measurements inside a gate give no birth
        expected[:2] = 0.0
    np.testing.assert_allclose(evidence.born, expected, rtol=2e-3, atol=1e-7)
    for j in np.flatnonzero(expected > 1e-3):
        slot = found.labels.tolist().index(50 + j)
        np.testing.assert_allclose(found.means[slot], [*SEEN[j], 0.0, 0.0], atol=1e-6)
        np.testing.assert_allclose(found.covariances[slot], np.diag([1.0, 1.0, 9.0, 9.0]), atol=1e-6)
