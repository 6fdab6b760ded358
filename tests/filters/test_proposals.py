import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from jaxloc.beliefs import Particles, Sensor
from jaxloc.filters import Auxiliary, Guided, LinearMotion, LinearSensor, ParticleFilter
from jaxloc.filters.proposals import score
from jaxloc.poses import SE2

F, Q = np.array([[1.0, 0.5], [0.0, 0.9]]), np.array([[0.5, 0.1], [0.1, 0.3]])
H, R = np.array([[1.0, 0.0], [1.0, 1.0], [0.0, 2.0]]), np.diag([0.2, 0.1, 0.4])
READING = np.array([2.0, 2.5, 0.5])
START = np.array([1.0, 0.5])


def planar(proposal, threshold=0.5):
    motion = LinearMotion(jnp.asarray(F, jnp.float32), jnp.asarray(Q, jnp.float32))
    sensor = LinearSensor(jnp.asarray(H, jnp.float32), jnp.asarray(R, jnp.float32))
    return ParticleFilter(motion, sensor, proposal=proposal, ess_threshold=threshold)


def conditioned(rows):
    """Mean, covariance and log likelihood of one step from START by the textbook's formulas."""
    h, r = H[rows], R[np.ix_(rows, rows)]
    s = h @ Q @ h.T + r
    gain = Q @ h.T @ np.linalg.inv(s)
    mean = F @ START + gain @ (READING[rows] - h @ F @ START)
    density = multivariate_normal.logpdf(READING[rows], h @ F @ START, s)
    return mean, Q - gain @ s @ gain.T, density


@pytest.fixture(scope="module", params=[Guided(), Auxiliary(guided=True)], ids=["guided", "adapted"])
def one_step(request):
    filt = planar(request.param)
    state = filt.init(Particles(jnp.broadcast_to(jnp.asarray(START, jnp.float32), (20_000, 2))))
    return filt, filt.predict(state, None, key=jax.random.key(0))


@pytest.mark.parametrize("valid", [[True, True, True], [True, False, True]], ids=["all", "some"])
def test_linear_sensors_are_met_exactly(one_step, valid):
    filt, state = one_step
    after, info = filt.update(state, jnp.asarray(READING, jnp.float32), jnp.array(valid), key=jax.random.key(1))
    mean, covariance, density = conditioned(np.flatnonzero(valid))
    assert np.isclose(info.ess, 20_000, rtol=1e-3)  # every weight is the same
    assert np.isclose(info.log_likelihood, density, atol=1e-3)
    assert np.allclose(after.particles.mean(), mean, atol=0.02)
    assert np.allclose(after.particles.covariance(), covariance, atol=0.02)


def test_a_second_sensor_weighs_alone(one_step):
    filt, state = one_step
    reading, one = jnp.asarray(READING, jnp.float32), jnp.array([True, False, False])
    first, a = filt.update(state, reading, one, key=jax.random.key(1))
    second, b = filt.update(first, reading, ~one, key=jax.random.key(2))
    assert np.isclose(a.log_likelihood + b.log_likelihood, conditioned([0, 1, 2])[2], atol=0.05)
    assert np.allclose(second.particles.mean(), conditioned([0, 1, 2])[0], atol=0.03)
    assert np.array_equal(second.particles.values, first.particles.values)


def test_no_measurement_leaves_the_draws(one_step):
    filt, state = one_step
    after, info = filt.update(state, jnp.zeros(3), jnp.zeros(3, bool), key=jax.random.key(1))
    same = jax.tree.map(lambda a, b: bool(jnp.all(a == b)), after, state)
    assert all(jax.tree.leaves(same)) and float(info.log_likelihood) == 0.0
    assert np.allclose(after.particles.covariance(), Q, atol=0.02)


class Distance(Sensor):
    """From the origin: far from linear for the cloud at hand."""

    def expect(self, state, measurement):
        return jnp.sqrt(jnp.sum(state**2) + 1e-12)[None]

    def covariance(self, state, measurement):
        return jnp.full((1, 1), 0.05)


@pytest.mark.slow
@pytest.mark.parametrize(
    "proposal", [Guided(), Auxiliary(), Auxiliary(guided=True)], ids=["guided", "ahead", "adapted"]
)
def test_nonlinear_sensors_are_weighed_exactly(proposal):
    motion = LinearMotion(jnp.asarray(F, jnp.float32), jnp.asarray(Q, jnp.float32))
    filt = ParticleFilter(motion, Distance(), proposal=proposal)
    state = filt.init(Particles(jnp.broadcast_to(jnp.asarray(START, jnp.float32), (40_000, 2))))
    state = filt.predict(state, None, key=jax.random.key(0))
    after, info = filt.update(state, jnp.array([1.0]), jnp.array(True), key=jax.random.key(1))
    grid = np.stack(np.meshgrid(np.linspace(-4, 6, 401), np.linspace(-4, 5, 401), indexing="ij"), -1)
    prior = multivariate_normal.pdf(grid, F @ START, Q)
    found = np.exp(-0.5 * (np.linalg.norm(grid, axis=-1) - 1.0) ** 2 / 0.05) / np.sqrt(2 * np.pi * 0.05)
    joint = prior * found
    evidence = joint.sum() * (10 / 400) * (9 / 400)
    assert np.isclose(info.log_likelihood, np.log(evidence), atol=0.05)
    assert np.allclose(after.particles.mean(), np.tensordot(joint / joint.sum(), grid, 2), atol=0.05)


def test_drafts_begin_used_up():
    filt = planar(Guided())
    state = filt.init(Particles(jnp.asarray(np.random.default_rng(0).normal(size=(50, 2)), jnp.float32)))
    after, _ = filt.update(state, jnp.asarray(READING, jnp.float32), jnp.array(True))
    assert np.array_equal(after.particles.values, state.particles.values)
    poses = jax.vmap(SE2)(jnp.ones(4), jnp.ones(4), jnp.ones(4))
    assert Guided().init_noise(poses).roots.shape == (4, 3, 3)


def test_score_is_zero_with_a_derivative():
    value, slope = jax.value_and_grad(lambda x: jnp.sum(score(x**3)))(jnp.array([1.0, 2.0]))
    assert float(value) == 0.0 and slope.tolist() == [3.0, 12.0]
