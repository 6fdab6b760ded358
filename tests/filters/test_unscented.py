import jax
import jax.numpy as jnp
import numpy as np
import pytest
from benchmarks.toolbox import Growth, Square, simulate

from jaxloc.beliefs import Gaussian, Motion, Sensor
from jaxloc.filters import Cubature, GaussHermite, SigmaPointFilter, Unscented, run, unscented
from jaxloc.poses import SO3, local, retract


@pytest.mark.parametrize(
    ("rule", "degree"),
    [(Unscented(), 3), (Unscented(0.5, 2.0, 1.0), 3), (Cubature(), 3), (GaussHermite(3), 5), (GaussHermite(5), 9)],
)
def test_rules_integrate_polynomials(rule, degree):
    offsets, weights, weights_covariance = rule.points(3)
    assert np.isclose(weights.sum(), 1.0)
    assert np.allclose((weights_covariance[:, None, None] * offsets[:, :, None] * offsets[:, None]).sum(0), np.eye(3))
    moments = {0: 1.0, 2: 1.0, 4: 3.0, 6: 15.0, 8: 105.0}
    for power in range(degree + 1):
        assert np.allclose(weights @ offsets**power, moments.get(power, 0.0), atol=1e-9)


def test_wrong_rules_are_named():
    with pytest.raises(ValueError, match="alpha"):
        Unscented(kappa=-3.0).points(3)
    with pytest.raises(ValueError, match="order"):
        GaussHermite(1).points(1)


class Swing(Motion):
    """A pendulum."""

    def move(self, state, control):
        return jnp.stack([state[0] + control * state[1], state[1] - control * 9.8 * jnp.sin(state[0])])

    def covariance(self, state, control):
        return 0.01 * control * jnp.eye(2, dtype=state.dtype)


class Height(Sensor):
    """How far the pendulum is to the side, and how fast."""

    def expect(self, state, measurement):
        return jnp.stack([jnp.sin(state[0]), state[1] * jnp.cos(state[0])])

    def covariance(self, state, measurement):
        return jnp.diag(jnp.asarray([0.01, 0.2], state.dtype))


def oracle(rule, readings, valid, dt, mean, covariance):
    """A plain covariance-form filter."""
    offsets, weights, weights_covariance = rule.points(2)
    means, total = [], 0.0

    def transform(function, mean, covariance):
        points = mean + offsets @ np.linalg.cholesky(covariance).T
        images = np.array([function(point) for point in points])
        center = weights @ images
        deviations = images - center
        both = np.concatenate([deviations, points - mean], axis=1)
        return center, (weights_covariance[:, None, None] * both[:, :, None] * both[:, None]).sum(0)

    for reading, here in zip(readings, valid, strict=True):
        mean, both = transform(lambda x: [x[0] + dt * x[1], x[1] - dt * 9.8 * np.sin(x[0])], mean, covariance)
        covariance = both[:2, :2] + 0.01 * dt * np.eye(2)
        center, both = transform(lambda x: [np.sin(x[0]), x[1] * np.cos(x[0])], mean, covariance)
        keep = np.flatnonzero(here)
        s = (both[:2, :2] + np.diag([0.01, 0.2]))[np.ix_(keep, keep)]
        across, error = both[2:, keep], (reading - center)[keep]
        gain = across @ np.linalg.inv(s)
        if len(keep):
            total -= 0.5 * (error @ np.linalg.solve(s, error) + np.linalg.slogdet(2 * np.pi * s)[1])
        mean, covariance = mean + gain @ error, covariance - gain @ s @ gain.T
        means.append(mean)
    return total, np.array(means), covariance


# T-57
@pytest.mark.parametrize("rule", [Unscented(0.6, 0.0, 1.0), GaussHermite(3)])
def test_equals_numpy(x64, rng, rule):
    readings, valid = 0.5 * rng.normal(size=(30, 2)), rng.uniform(size=(30, 2)) < 0.7
    mean, covariance = np.array([0.3, 0.1]), np.array([[0.3, 0.1], [0.1, 0.2]])
    filt = SigmaPointFilter(Swing(), Height(), rule)
    initial = filt.init(Gaussian(jnp.asarray(mean), jnp.asarray(covariance)))
    last, history = run(filt, initial, jnp.full(30, 0.05), jnp.asarray(readings), jnp.asarray(valid))
    total, means, covariance = oracle(rule, readings, valid, 0.05, mean, covariance)
    assert np.allclose(history.states.mean, means, atol=1e-8)
    assert np.allclose(last.covariance, covariance, atol=1e-8)
    assert np.isclose(jnp.sum(history.infos.log_likelihood), total)


def test_negative_weights_and_nonfinite_readings_stay_finite():
    filt = SigmaPointFilter(Swing(), Height(), Unscented(0.01, 0.0, 0.0))
    readings = jnp.ones((6, 2)).at[1, 0].set(jnp.nan).at[2].set(1e30)

    @jax.jit
    @jax.value_and_grad
    def total(covariance):
        initial = filt.init(Gaussian(jnp.ones(2), covariance))
        last, history = run(filt, initial, jnp.full(6, 0.05), readings, jnp.ones(6, bool))
        return jnp.sum(history.infos.log_likelihood) + jnp.sum(last.mean)

    for covariance in (jnp.eye(2), jnp.zeros((2, 2)), 1e6 * jnp.eye(2)):
        value, gradient = total(covariance)
        assert np.isfinite(value) and np.isfinite(gradient).all()


def test_intrinsic_mean_of_rotations(x64, rng):
    center = SO3.exp(jnp.array([0.5, -1.0, 2.0]))
    deltas = 0.3 * rng.normal(size=(8, 3))
    values = jax.vmap(lambda d: retract(center, d))(jnp.asarray(np.concatenate([deltas, -deltas])))
    mean, deviations = jax.jit(unscented.intrinsic_mean)(values, jnp.full(16, 1.0 / 16.0))
    assert np.allclose(local(center, mean), 0.0, atol=1e-6)
    assert np.allclose(np.asarray(deviations).mean(axis=0), 0.0, atol=1e-6)


# EKF/UKF toolbox: UKF 87.9, CKF 72.3, GHKF 40.9; benchmarks have the other scenarios.
def test_published_growth_model():
    motion, sensor, prior = Growth(), Square(), Gaussian(jnp.array([0.1]), jnp.eye(1))
    controls = jnp.arange(1.0, 501.0)
    truth, readings = simulate(motion, sensor, prior, controls, 100, 0)
    rules = (Unscented(0.5, 2.0, 2.0), Cubature(), GaussHermite(10))

    @jax.jit
    @jax.vmap
    def errors(truth, reading):
        found = []
        for rule in rules:
            filt = SigmaPointFilter(motion, sensor, rule)
            _, history = run(filt, filt.init(prior), controls, reading, jnp.ones(500, bool))
            found.append(jnp.mean((history.states.mean - truth) ** 2))
        return jnp.stack(found)

    found = np.asarray(errors(truth, readings)).mean(axis=0)
    assert (np.abs(found - [87.9, 72.3, 40.9]) < [4.0, 3.0, 3.0]).all(), found
