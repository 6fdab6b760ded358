"""Joint association probabilities against enumeration and Stone Soup; belief propagation against both."""  # T-60

import datetime
import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxloc as jl


def enumerate_all(weights, missed):
    """Marginals and normalizer over all one-to-one associations, one by one."""
    num, size = weights.shape
    pairs, total = np.zeros((num, size)), 0.0
    for choice in itertools.product(range(-1, size), repeat=num):
        taken = [c for c in choice if c >= 0]
        if len(set(taken)) < len(taken):
            continue
        weight = np.prod([missed[i] if c < 0 else weights[i, c] for i, c in enumerate(choice)])
        total += weight
        for i, c in enumerate(choice):
            if c >= 0:
                pairs[i, c] += weight
    return pairs / total, total


def problem(rng, shape, scale=2.0):
    odds = rng.normal(scale=scale, size=shape)
    odds[rng.uniform(size=shape) < 0.3] = -np.inf
    return odds, np.log(rng.uniform(0.05, 1.0, size=shape[0]))


@pytest.mark.parametrize("shape", [(4, 3), (3, 5)])
def test_exact_is_enumeration(shape, rng, x64):
    odds, missed = problem(rng, shape)
    pairs, total = enumerate_all(np.exp(odds), np.exp(missed))
    found = jax.jit(jl.tracking.Exact().associate)(jnp.asarray(odds), jnp.asarray(missed))
    np.testing.assert_allclose(found.pairs, pairs, atol=1e-12)
    np.testing.assert_allclose(found.missed, 1.0 - pairs.sum(axis=1), atol=1e-12)
    assert float(found.log_normalizer) == pytest.approx(np.log(total), rel=1e-10)


def test_propagation_is_close_to_exact(rng):
    problems = [problem(rng, (5, 5)) for _ in range(200)]
    odds, missed = (jnp.asarray(np.stack(part), jnp.float32) for part in zip(*problems, strict=True))
    exact = jax.jit(jax.vmap(jl.tracking.Exact().associate))(odds, missed)
    close = jax.jit(jax.vmap(jl.tracking.BeliefPropagation().associate))(odds, missed)
    apart = jnp.sum(jnp.abs(exact.pairs - close.pairs), axis=2) + jnp.abs(exact.missed - close.missed)
    assert float(jnp.mean(0.5 * apart)) < 0.02 and float(jnp.quantile(0.5 * apart, 0.95)) < 0.06
    np.testing.assert_allclose(jnp.sum(close.pairs, axis=2) + close.missed, 1.0, atol=1e-5)
    assert float(jnp.mean(jnp.abs(exact.log_normalizer - close.log_normalizer))) < 0.1


def test_propagation_is_exact_on_trees(rng):
    # One track, or one measurement, makes no loop.
    for shape in ((1, 4), (4, 1)):
        odds, missed = (jnp.asarray(part, jnp.float32) for part in problem(rng, shape))
        exact = jl.tracking.Exact().associate(odds, missed)
        close = jl.tracking.BeliefPropagation(3).associate(odds, missed)
        np.testing.assert_allclose(close.pairs, exact.pairs, atol=1e-5)
        np.testing.assert_allclose(close.log_normalizer, exact.log_normalizer, atol=1e-5)


def test_too_large_for_exact():
    with pytest.raises(ValueError, match="Use BeliefPropagation"):
        jl.tracking.Exact().associate(jnp.zeros((15, 15)), jnp.zeros(15))


def test_extreme_weights_stay_finite():
    odds = jnp.array([[200.0, -jnp.inf], [199.0, -200.0], [-jnp.inf, -jnp.inf]])
    missed = jnp.log(jnp.array([1e-7, 1e-7, 1.0]))
    for marginals in (jl.tracking.Exact(), jl.tracking.BeliefPropagation(50)):
        found = marginals.associate(odds, missed)
        assert all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(found))
        np.testing.assert_allclose(found.missed[2], 1.0, atol=1e-6)
        slopes = jax.grad(lambda w, marginals=marginals: marginals.associate(w, missed).log_normalizer)(odds)
        assert bool(jnp.all(jnp.isfinite(slopes)))


def make_tracker(detection, density):
    eye = jnp.eye(2)
    motion = jl.filters.ConstantVelocity(0.1, axes=2)
    model = jl.tracking.TargetModel(
        jl.filters.KalmanFilter(motion, jl.filters.LinearSensor(jnp.eye(2, 4), 0.75 * eye)),
        detection=detection,
        survival=1.0,
        clutter=jl.tracking.UniformClutter(density, 1.0),
        birth=jl.tracking.Birth(),
    )
    return jl.tracking.JointProbabilisticDataAssociation(model, capacity=3, gate=None, marginals=jl.tracking.Exact())


def test_update_is_stone_soups(x64):
    pytest.importorskip("stonesoup")
    from stonesoup.dataassociator.probability import JPDA
    from stonesoup.functions import gm_reduce_single
    from stonesoup.hypothesiser.probability import PDAHypothesiser
    from stonesoup.models.measurement.linear import LinearGaussian
    from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
    from stonesoup.predictor.kalman import KalmanPredictor
    from stonesoup.types.array import StateVector, StateVectors
    from stonesoup.types.detection import Detection
    from stonesoup.types.state import GaussianState
    from stonesoup.types.track import Track
    from stonesoup.updater.kalman import KalmanUpdater

    detection, density = 0.9, 0.125
    now = datetime.datetime(2020, 1, 1)
    means = np.array([[0.0, 0.0, 1.0, 0.0], [2.0, 0.5, 0.0, 1.0], [1.0, -1.5, 0.5, 0.5]])
    covariance = np.diag([1.5, 1.0, 0.3, 0.3])
    z = np.array([[0.4, 0.2], [1.6, 0.1], [1.1, -1.0]])

    order = [0, 2, 1, 3]  # Stone Soup's states are (x, vx, y, vy)
    still = CombinedLinearGaussianTransitionModel([ConstantVelocity(0.0), ConstantVelocity(0.0)])
    sensor = LinearGaussian(4, (0, 2), 0.75 * np.eye(2))
    updater = KalmanUpdater(sensor)
    theirs = PDAHypothesiser(KalmanPredictor(still), updater, density, detection, prob_gate=1.0, include_all=True)
    tracks = [Track([GaussianState(m[order], covariance[np.ix_(order, order)], now)]) for m in means]
    detections = [Detection(StateVector(point), timestamp=now, measurement_model=sensor) for point in z]
    found = JPDA(theirs).associate(tracks, detections, now)

    tracker = make_tracker(detection, density)
    prior = jl.beliefs.Mixture(jnp.ones(3), jnp.asarray(means), jnp.stack([jnp.asarray(covariance)] * 3))
    after, _ = eqx.filter_jit(tracker.update)(tracker.init(prior), jnp.asarray(z), jnp.ones(3, bool))
    density_after = after.densities()
    back = np.argsort(order)
    for k, track in enumerate(tracks):
        weights, states = [], []
        for hypothesis in found[track]:
            weights.append(float(hypothesis.probability))
            states.append(updater.update(hypothesis) if hypothesis else hypothesis.prediction)
        assert len(weights) == 4
        vectors, spreads = StateVectors([s.state_vector for s in states]), np.stack([s.covar for s in states], axis=2)
        mean, covariance = gm_reduce_single(vectors, spreads, np.array(weights))
        slot = after.labels.tolist().index(k)
        np.testing.assert_allclose(density_after.mean[slot], np.ravel(mean)[back], atol=1e-6)
        np.testing.assert_allclose(density_after.covariance[slot], covariance[np.ix_(back, back)], atol=1e-6)
