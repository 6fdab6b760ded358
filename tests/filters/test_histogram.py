import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.beliefs import Gaussian, Motion, Sensor
from jaxloc.filters import HistogramFilter, KalmanFilter, LinearMotion, LinearSensor, histogram, run
from jaxloc.poses import SE2, local, retract


# T-1, T-3, T-55
def test_equals_the_kalman_filter(x64, rng):
    motion = LinearMotion(jnp.array([[0.9]]), jnp.array([[0.5]]))
    sensor = LinearSensor(jnp.array([[1.0]]), jnp.array([[0.8]]))
    prior = Gaussian(jnp.array([1.0]), jnp.array([[2.0]]))
    readings, valid = jnp.asarray(rng.normal(size=(8, 1))), jnp.asarray(rng.uniform(size=8) < 0.8)
    ours, theirs = HistogramFilter(motion, sensor), KalmanFilter(motion, sensor)
    cells = histogram.box((-12.0,), (12.0,), (241,))
    last, history = run(ours, ours.init_gaussian(cells, prior), None, readings, valid)
    exact, peer = run(theirs, theirs.init(prior), None, readings, valid)
    found = last.gaussian()
    assert np.allclose(found.mean, exact.mean, atol=1e-6) and np.allclose(found.covariance, exact.covariance, atol=1e-5)
    assert np.allclose(history.infos.log_likelihood, peer.infos.log_likelihood, atol=1e-6)
    assert np.allclose(history.states.mass.sum(axis=1), 1.0)
    density = np.exp(
        -0.5 * (np.asarray(cells.points[:, 0]) - float(exact.mean[0])) ** 2 / float(exact.covariance[0, 0])
    )
    assert np.allclose(last.density, density / np.sqrt(2 * np.pi * float(exact.covariance[0, 0])), atol=1e-5)


class Drift(Motion):
    """A pose that stays, but for noise."""

    def move(self, state, control):
        return retract(state, control)

    def covariance(self, state, control):
        return jnp.diag(jnp.array([0.3, 0.3, 0.2]))


class North(Sensor):
    """A compass."""

    def expect(self, state, measurement):
        return state.rotation

    def covariance(self, state, measurement):
        return jnp.array([[0.1]])


def test_poses_conserve_mass_and_wrap():
    filt = HistogramFilter(Drift(), North())
    state = filt.init(histogram.plane((-2.0, -1.0), (2.0, 1.0), (4, 3, 16)))

    @jax.jit
    def step(state, heading):
        moved = filt.predict(state, jnp.array([0.0, 0.0, 0.1]))
        after, info = filt.update(moved, SE2(0.0, 0.0, heading).rotation, jnp.array(True))
        return moved, after, info

    for _ in range(3):
        moved, state, info = step(state, jnp.pi)
        assert np.isclose(moved.mass.sum(), 1.0, atol=1e-5) and (moved.mass >= 0.0).all()
        assert np.isclose(state.mass.sum(), 1.0, atol=1e-5) and info.ok and np.isfinite(info.entropy)
    mean = state.gaussian().mean
    assert np.abs(local(SE2(0.0, 0.0, jnp.pi), mean)).max() < 0.1


def test_nonfinite_measurements_change_nothing():
    eye = jnp.eye(1)
    filt = HistogramFilter(LinearMotion(eye, eye), LinearSensor(eye, 1e-3 * eye))
    state = filt.init(histogram.box((-3.0,), (3.0,), (13,)))

    @jax.jit
    @jax.value_and_grad
    def likelihood(reading):
        return filt.update(state, reading, jnp.array(True))[1].log_likelihood

    update = jax.jit(lambda reading: filt.update(state, reading, jnp.array(True)))
    for reading, ok in ((jnp.nan, True), (1e25, False)):
        same, info = update(jnp.array([reading]))
        value, slope = likelihood(jnp.array([reading]))
        assert np.allclose(same.mass, state.mass) and bool(info.ok) == ok
        assert value == 0.0 and np.isfinite(slope).all()


def test_wrong_boxes_are_named():
    with pytest.raises(ValueError, match="equal length"):
        histogram.box((0.0,), (1.0, 2.0), (3,))
    with pytest.raises(ValueError, match="empty"):
        histogram.box((0.0,), (0.0,), (3,))
