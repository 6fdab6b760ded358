"""T-74, T-77: the scenarios of many targets: truth in closed form, statistics, and the models of trackers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxloc as jl
from jaxloc.data.simulate.targets import LinearScenario, TurningScenario, simulate_targets

RUNS = 40
simulate = jax.jit(jax.vmap(lambda scenario, key: simulate_targets(scenario, key=key), in_axes=(None, 0)))


@pytest.fixture(scope="module")
def straight():
    scenario = LinearScenario()
    return scenario, simulate(scenario, jax.random.split(jax.random.key(0), RUNS))


@pytest.fixture(scope="module")
def turning():
    scenario = TurningScenario()
    return scenario, simulate(scenario, jax.random.split(jax.random.key(1), RUNS))


def test_straight_lines_are_straight(straight):
    _, drives = straight
    truth, there = np.asarray(drives.truth[0]), np.asarray(drives.truth_valid[0])
    # Scans are counted from 1.
    assert [there[k - 1].sum() for k in (1, 19, 20, 40, 60, 70, 71, 80, 100)] == [3, 3, 6, 8, 10, 10, 8, 10, 10]
    np.testing.assert_allclose(truth[69, 0], [0.0, -700.0, 0.0, -10.0], atol=1e-3)
    np.testing.assert_allclose(truth[99, 4], [400.0 - 2.5 * 81, -600.0 + 810.0, -2.5, 10.0], atol=1e-3)


def test_turns_keep_their_speed_and_rate(turning):
    _, drives = turning
    truth, there = np.asarray(drives.truth[0], float), np.asarray(drives.truth_valid[0])
    assert [there[k - 1].sum() for k in (1, 9, 10, 20, 40, 60, 66, 67, 80, 81)] == [1, 1, 4, 5, 8, 10, 10, 9, 9, 7]
    # The second target: complex numbers turn it.
    rate = -2.0 / 3.0 * np.pi / 180.0
    seconds, start, velocity = 50, -255.8857 + 1011.4102j, 20.0 + 3.0j
    angle = rate * seconds
    end = start + velocity * (np.exp(1j * angle) - 1.0) / (1j * rate)
    turned = velocity * np.exp(1j * angle)
    expected = [end.real, end.imag, turned.real, turned.imag, rate]
    np.testing.assert_allclose(truth[10 + seconds - 2, 1], expected, rtol=1e-4)
    # All of it lies in front of the sensor.
    assert (truth[there][:, 1] > 0).all()


@pytest.mark.parametrize("name", ["straight", "turning"])
def test_numbers_of_measurements(name, request):
    scenario, drives = request.getfixturevalue(name)
    valid, sources = np.asarray(drives.valid), np.asarray(drives.sources)
    assert (np.diff(valid.astype(int), axis=2) <= 0).all() and (sources[~valid] == -1).all()
    false = (valid & (sources < 0)).sum(axis=2)
    expected = float(scenario.clutter_rate)
    scans = false.size
    assert abs(false.mean() - expected) < 4.0 * np.sqrt(expected / scans)
    assert false.var() == pytest.approx(expected, rel=0.1)
    alive = np.asarray(drives.truth_valid).sum()
    assert abs((sources >= 0).sum() / alive - 0.98) < 4.0 * np.sqrt(0.98 * 0.02 / alive)
    assert valid.sum(axis=2).max() < scenario.capacity


def residuals_of(drives):
    """Measurements of targets, their states, and whether they are measured of one."""
    sources = np.asarray(drives.sources)
    states = np.take_along_axis(np.asarray(drives.truth), np.maximum(sources, 0)[..., None], axis=2)
    return states[sources >= 0], sources >= 0


def test_noise_and_clutter_of_positions(straight):
    scenario, drives = straight
    states, real = residuals_of(drives)
    measured = np.asarray(drives.measurements)
    np.testing.assert_allclose(np.cov((measured[real] - states[:, :2]).T), 100.0 * np.eye(2), atol=4.0)
    false = measured[np.asarray(drives.valid) & ~real]
    assert np.abs(false).max() <= 1000.0
    np.testing.assert_allclose(false.var(axis=0), 2000.0**2 / 12.0, rtol=0.03)


def test_noise_and_clutter_of_ranges_and_bearings(turning):
    scenario, drives = turning
    states, real = residuals_of(drives)
    bearing = drives.measurements.bearing
    distance, angle = np.asarray(drives.measurements.range), np.arctan2(bearing.sin, bearing.cos)
    across = angle[real] - np.arctan2(states[:, 1], states[:, 0])
    across = (across + np.pi) % (2.0 * np.pi) - np.pi
    assert np.std(distance[real] - np.hypot(states[:, 0], states[:, 1])) == pytest.approx(10.0, rel=0.03)
    assert np.rad2deg(across.std()) == pytest.approx(2.0, rel=0.03)
    false = np.asarray(drives.valid) & ~real
    assert distance[false].var() == pytest.approx(2000.0**2 / 12.0, rel=0.03)
    assert angle[false].var() == pytest.approx(np.pi**2 / 12.0, rel=0.03)
    assert angle[false].min() >= -1e-5


def test_models_of_a_tracker(x64):
    straight, turning = LinearScenario(), TurningScenario()
    gain = 5.0 * np.array([[0.5, 0.0], [0.0, 0.5], [1.0, 0.0], [0.0, 1.0]])
    np.testing.assert_allclose(straight.motion.noise_covariance, gain @ gain.T)
    state = jnp.array([1.0, 2.0, 3.0, 4.0])
    np.testing.assert_allclose(straight.motion.move(state, None), [4.0, 6.0, 3.0, 4.0])
    assert straight.starts.dtype == np.float64
    noise = np.asarray(turning.motion.covariance(jnp.zeros(5), None))
    np.testing.assert_allclose(noise[:4, :4], gain @ gain.T)
    np.testing.assert_allclose(noise[4], [0.0, 0.0, 0.0, 0.0, np.deg2rad(1.0) ** 2])
    sensor, reading = turning.sensor, turning.reading(jnp.array([100.0, 1.0]))
    state = jnp.array([30.0, 40.0, 1.0, 2.0, 0.1])
    expected, jacobian = sensor.linearize(state, reading)
    assert float(expected.range) == pytest.approx(50.0)
    slow = jl.beliefs.Sensor.linearize(sensor, state, reading)[1]
    np.testing.assert_allclose(jacobian, slow, atol=1e-12)


def test_one_key_is_one_of_a_batch(straight):
    scenario, drives = straight
    one = simulate_targets(scenario, key=jax.random.split(jax.random.key(0), RUNS)[3])
    np.testing.assert_allclose(one.measurements, drives.measurements[3], rtol=1e-4, atol=1e-3)
    np.testing.assert_array_equal(one.sources, drives.sources[3])
