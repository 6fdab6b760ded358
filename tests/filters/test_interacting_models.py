"""The interacting filters against plain NumPy, and their smoother against all sequences of modes."""

from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from benchmarks import toolbox

from jaxloc.beliefs import Gaussian
from jaxloc.filters import InteractingMultipleModel, KalmanFilter, LinearMotion, LinearSensor, run, smooth_interacting

STEPS = 5
TRANSITION = np.array([[0.9, 0.1], [0.3, 0.7]])
MODELS = (
    (np.array([[1.0, 0.5], [0.0, 1.0]]), 0.01 * np.eye(2)),
    (np.array([[1.0, 0.5], [0.0, 0.5]]), np.diag([0.5, 2.0])),
)
MATRIX, SPREAD = np.array([[1.0, 0.0]]), np.array([[0.2]])


def bank(transition):
    sensor = LinearSensor(jnp.asarray(MATRIX), jnp.asarray(SPREAD))
    filters = tuple(KalmanFilter(LinearMotion(*map(jnp.asarray, model)), sensor) for model in MODELS)
    return InteractingMultipleModel(filters, transition)


def kalman(mean, covariance, model, reading):
    mean, covariance = model[0] @ mean, model[0] @ covariance @ model[0].T + model[1]
    s = MATRIX @ covariance @ MATRIX.T + SPREAD
    gain = covariance @ MATRIX.T / s
    error = reading - MATRIX @ mean
    likelihood = -0.5 * (error[0] ** 2 / s[0, 0] + np.log(2 * np.pi * s[0, 0]))
    return mean + gain @ error, covariance - gain @ s @ gain.T, likelihood


def blom(transition, readings):
    """The algorithm of Blom and Bar-Shalom."""
    means, covariances, shares = [np.zeros(2)] * 2, [np.eye(2)] * 2, np.array([0.5, 0.5])
    total, history = 0.0, []
    for reading in readings:
        predicted = shares @ transition
        likelihoods, new = np.zeros(2), []
        for j in range(2):
            weights = shares * transition[:, j] / predicted[j]
            mean = weights @ np.array(means)
            covariance = sum(
                w * (c + np.outer(m - mean, m - mean)) for w, m, c in zip(weights, means, covariances, strict=True)
            )
            *state, likelihoods[j] = kalman(mean, covariance, MODELS[j], reading)
            new.append(state)
        means, covariances = [state[0] for state in new], [state[1] for state in new]
        joint = predicted * np.exp(likelihoods)
        total, shares = total + np.log(joint.sum()), joint / joint.sum()
        history.append((shares, shares @ np.array(means)))
    return total, history


def everything_at_once(readings):
    """Exact mode probabilities and means given all readings, over all sequences of modes."""
    scores, shares, means = [], [], []
    for modes in product(range(2), repeat=STEPS):
        mean, covariance, score = np.zeros(2), np.eye(2), 0.0
        before = np.array([0.5, 0.5])
        past = []
        for k, mode in enumerate(modes):
            score += np.log((before @ TRANSITION)[mode] if k == 0 else TRANSITION[modes[k - 1], mode])
            past.append((mean, covariance))
            mean, covariance, likelihood = kalman(mean, covariance, MODELS[mode], readings[k])
            score += likelihood
        past.append((mean, covariance))
        path, smoothed = [mean], mean
        smoothed_covariance = covariance
        for k in range(STEPS - 1, 0, -1):
            mean, covariance = past[k]
            transition, noise = MODELS[modes[k]]
            predicted = transition @ covariance @ transition.T + noise
            gain = covariance @ transition.T @ np.linalg.inv(predicted)
            smoothed = mean + gain @ (smoothed - transition @ mean)
            smoothed_covariance = covariance + gain @ (smoothed_covariance - predicted) @ gain.T
            path.insert(0, smoothed)
        scores.append(score)
        shares.append(np.eye(2)[list(modes)])
        means.append(np.array(path))
    weights = np.exp(np.array(scores) - np.max(scores))
    weights /= weights.sum()
    return np.tensordot(weights, np.array(shares), 1), np.tensordot(weights, np.array(means), 1)


@pytest.fixture(scope="module")
def results():
    with jax.enable_x64(True):
        readings = np.array([[0.1], [0.0], [3.0], [5.5], [6.0]])

        def filtered(transition):
            filt = bank(transition)
            start = filt.init(Gaussian(jnp.zeros(2), jnp.eye(2)))
            return filt, run(filt, start, None, jnp.asarray(readings), jnp.ones(STEPS, bool))

        @jax.jit
        @jax.value_and_grad
        def score(transition):
            return jnp.sum(filtered(transition)[1][1].infos.log_likelihood)

        @jax.jit
        def everything(transition):
            filt, (last, history) = filtered(transition)
            smoothed = smooth_interacting(filt, history, None)
            combined = [jax.vmap(lambda s: s.combined())(s).mean for s in (history.states, smoothed)]
            return history, smoothed, combined, last

        value, gradient = score(jnp.asarray(TRANSITION))
        return readings, (value, everything(jnp.asarray(TRANSITION))), gradient


# T-6
def test_equals_numpy(results):
    readings, (total, (history, _, combined, _)), _ = results
    expected, steps = blom(TRANSITION, readings)
    assert np.isclose(total, expected)
    assert np.allclose(history.infos.probabilities, [shares for shares, _ in steps])
    assert np.allclose(combined[0], [mean for _, mean in steps])


def test_gradient_by_the_transition_matrix(results):
    readings, _, gradient = results
    rng = np.random.default_rng(0)
    way = rng.normal(size=(2, 2))
    ends = [blom(TRANSITION + h * way, readings)[0] for h in (1e-6, -1e-6)]
    assert np.isclose(np.sum(np.asarray(gradient) * way), (ends[0] - ends[1]) / 2e-6, rtol=1e-6)


def test_smoother_is_near_the_exact_posterior(results):
    readings, (_, (history, smoothed, combined, _)), _ = results
    shares, means = everything_at_once(readings)
    filtered = np.abs(np.asarray(history.infos.probabilities) - shares).max()
    assert np.abs(np.exp(smoothed.log_probabilities) - shares).max() < 0.15 * filtered
    assert np.abs(np.asarray(combined[1]) - means).max() < 0.2


def test_one_that_is_not_there_and_wrong_shapes(results):
    _, (_, (_, _, _, last)), _ = results
    filt = bank(jnp.asarray(TRANSITION, jnp.float32))
    with pytest.raises(ValueError, match=r"shape \(2, 2\)"):
        bank(jnp.eye(3))
    assert len(filt.filters) == 2 and int(last.step) == STEPS


# EKF/UKF toolbox: IMM 0.0229; benchmarks have its smoother and the other scenarios.
@pytest.mark.slow
def test_published_maneuvers():
    scores = toolbox.maneuvers(100, whole=False)
    assert abs(scores["imm"].mean - 0.0229) < 0.001
