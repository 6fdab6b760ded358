"""Probabilistic data association against a mixture in NumPy, and its gradients."""  # T-59

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

import jaxloc as jl
from jaxloc.tracking import pda

SQUARE = np.array([[2.0, 0.5], [0.5, 1.0]])


def make_tracker(parameters=None, *, kind=jl.tracking.ProbabilisticDataAssociation, **options):
    """With detection probability, clutter rate, intensity of the motion's noise and variance of the sensor's."""
    detection, clutter, q, r = jnp.array([0.9, 3.0, 0.1, 1.0]) if parameters is None else parameters
    dtype = r.dtype
    motion = jl.filters.ConstantVelocity(q, axes=2)
    filt = jl.filters.KalmanFilter(motion, jl.filters.LinearSensor(jnp.eye(2, 4, dtype=dtype), r * jnp.asarray(SQUARE)))
    model = jl.tracking.TargetModel(
        filt,
        detection=detection,
        survival=jnp.asarray(0.99, dtype),
        clutter=jl.tracking.UniformClutter(clutter, jnp.asarray(400.0, dtype)),
        birth=jl.tracking.PointBirth(
            jnp.asarray(0.1, dtype), jnp.asarray(400.0, dtype), jnp.eye(2, dtype=dtype), jnp.ones(2, dtype)
        ),
    )
    return kind(model, capacity=6, **options)


def make_prior(dtype=np.float64):
    means = np.array([[0.0, 0.0, 1.0, 0.0], [3.0, 0.0, 0.0, 1.0]])
    root = np.tril(np.random.default_rng(1).normal(size=(2, 4, 4))) * 0.4 + np.eye(4)
    covariances = root @ root.swapaxes(1, 2)
    return jl.beliefs.Mixture(*(jnp.asarray(part, dtype) for part in (np.array([0.9, 0.6]), means, covariances)))


def make_scan(dtype=np.float64):
    z = np.array([[0.6, 0.3], [2.5, -0.4], [1.5, 0.2], [np.nan, 0.0], [-1.0, 1.5]])
    return jnp.asarray(z, dtype), jnp.array([True, True, True, True, False])


def test_weights_are_shares(rng):
    odds, missed = rng.normal(scale=3.0, size=(4, 5)), np.log(rng.uniform(size=4))
    odds[1, 2] = odds[3] = -np.inf
    found = pda.associate_alone(jnp.asarray(odds, jnp.float32), jnp.asarray(missed, jnp.float32))
    total = np.exp(missed) + np.exp(odds).sum(axis=1)
    np.testing.assert_allclose(found.pairs, np.exp(odds) / total[:, None], rtol=1e-4)
    np.testing.assert_allclose(found.missed, np.exp(missed) / total, rtol=1e-4)
    np.testing.assert_allclose(found.log_normalizer, np.log(total).sum(), rtol=1e-5)


def test_update_has_the_moments_of_the_mixture(x64):
    tracker, prior, (z, valid) = make_tracker(), make_prior(), make_scan()
    tracker = jax.tree.map(lambda leaf: leaf.astype(jnp.float64), tracker)
    after, info = eqx.filter_jit(tracker.update)(tracker.init(prior), z, valid)
    likelihood = 3 * np.log(3.1 / 400.0) - 3.1
    h, noise = np.eye(2, 4), SQUARE
    for k in range(2):
        r, m, p = (np.asarray(part[k]) for part in (prior.weights, prior.means, prior.covariances))
        s = h @ p @ h.T + noise
        gain = p @ h.T @ np.linalg.inv(s)
        weights, means, spreads = [1 - r * 0.9], [m], [p]
        for point in np.asarray(z)[:3]:
            weights.append(r * 0.9 * multivariate_normal.pdf(point, h @ m, s) / (3.1 / 400.0))
            means.append(m + gain @ (point - h @ m))
            spreads.append(p - gain @ s @ gain.T)
        likelihood += np.log(np.sum(weights))
        beta = np.array(weights) / np.sum(weights)
        exists = beta.copy()
        exists[0] *= r * 0.1 / (1 - r * 0.9)
        assert float(after.existence[k]) == pytest.approx(exists.sum(), rel=1e-6)
        exists /= exists.sum()
        mean = exists @ np.array(means)
        apart = np.array(means) - mean
        expected = np.einsum("i,ijk->jk", exists, np.array(spreads)) + np.einsum("i,ij,ik->jk", exists, apart, apart)
        slot = after.labels.tolist().index(k)
        found = after.densities()
        np.testing.assert_allclose(found.mean[slot], mean, rtol=1e-6, atol=1e-8)
        np.testing.assert_allclose(found.covariance[slot], expected, rtol=1e-6, atol=1e-8)
    assert float(info.log_likelihood) == pytest.approx(likelihood, rel=1e-6)


@pytest.mark.slow
def test_no_measurements_leave_the_state(dtype):
    tracker = make_tracker()
    tracker = jax.tree.map(lambda leaf: leaf.astype(dtype), tracker)
    state = tracker.init(make_prior(dtype))
    after, info = eqx.filter_jit(tracker.update)(state, jnp.full((3, 2), jnp.nan, dtype), jnp.ones(3, bool))
    assert bool(info.ok) and after.existence.dtype == dtype and info.log_likelihood.dtype == dtype
    np.testing.assert_allclose(after.means()[:2], state.means()[:2])
    assert bool(jnp.all(after.existence <= state.existence))


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"kind": jl.tracking.JointProbabilisticDataAssociation},
        {"kind": jl.tracking.JointProbabilisticDataAssociation, "marginals": jl.tracking.Exact()},
    ],
    ids=["alone", "propagation", "exact"],
)
def test_gradient_of_the_likelihood(options, x64):  # T-60
    z, valid = make_scan()
    scans = jnp.stack([z, z + 0.3, jnp.full_like(z, jnp.nan), z + 0.9])

    @jax.jit
    @jax.value_and_grad
    def likelihood(parameters):
        tracker = make_tracker(parameters, **options)
        state = tracker.init(make_prior())
        _, history = jl.filters.run(tracker, state, jnp.full(4, 0.5), scans, jnp.stack([valid] * 4))
        return jnp.sum(history.infos.log_likelihood)

    start = jnp.array([0.9, 3.0, 0.1, 1.0])
    _, slopes = likelihood(start)
    steps = 1e-6 * np.eye(4)
    expected = [float(likelihood(start + step)[0] - likelihood(start - step)[0]) / 2e-6 for step in steps]
    np.testing.assert_allclose(slopes, expected, rtol=1e-4, atol=1e-5)
