"""Filters on planar poses that see landmarks: consistency, gates, robustness, iterations, gradients."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

from jaxloc.beliefs import Gaussian, Sensor, chi2_quantile
from jaxloc.filters import BodyTwist, ConstantVelocity, ExtendedKalmanFilter, SigmaPointFilter, TwistMotion, run
from jaxloc.poses import SE2, SO2, local, retract
from jaxloc.solvers.robust_kernels import Huber, Tukey

RUNS, STEPS = 200, 20


class Landmarks(Sensor):
    """Ranges, and bearings as rotations, of known landmarks."""

    places: jax.Array
    noise: jax.Array

    def expect(self, state, measurement):
        seen = state.inverse().apply(self.places)
        ranges = jnp.sqrt(jnp.sum(seen**2, axis=1))
        return ranges, jax.vmap(SO2.from_angle)(jnp.arctan2(seen[:, 1], seen[:, 0]))

    def covariance(self, state, measurement):
        return jnp.diag(jnp.concatenate([jnp.full(2, self.noise[0] ** 2), jnp.full(2, self.noise[1] ** 2)]))


def models(dtype=float):
    places = jnp.asarray([[4.0, 3.0], [-2.0, 5.0]], dtype)
    return TwistMotion(jnp.diag(jnp.asarray([1e-3, 2e-4, 1e-3], dtype))), Landmarks(
        places, jnp.asarray([0.1, 0.03], dtype)
    )


def prior(dtype=float):
    return Gaussian(SE2.identity(dtype), jnp.diag(jnp.asarray([0.02, 0.02, 0.005], dtype)))


def controls(dtype=float):
    twist = jnp.broadcast_to(jnp.asarray([1.0, 0.0, 0.4], dtype), (STEPS, 3))
    return BodyTwist(twist, jnp.full(STEPS, 0.5, dtype))


def drive(key):
    """A true path from a start drawn from the prior, and what is read along it."""
    motion, sensor = models()
    first, second = jax.random.split(key)

    def advance(pose, inputs):
        control, key = inputs
        keys = jax.random.split(key)
        pose = motion.sample(pose, control, key=keys[0])
        noise = jnp.sqrt(jnp.diagonal(sensor.covariance(pose, None))) * jax.random.normal(keys[1], (4,))
        return pose, (pose, retract(sensor.expect(pose, None), noise))

    start = jax.tree.map(lambda leaf: leaf[0], prior().sample(1, key=first))
    return jax.lax.scan(advance, start, (controls(), jax.random.split(second, STEPS)))[1]


@pytest.fixture(scope="module")
def drives():
    return jax.jit(jax.vmap(drive))(jax.random.split(jax.random.key(1), RUNS))


def inside(values, dof):
    """Whether the mean of chi-square values over the runs lies in its 95 % band, for each step but a few."""
    low, high = (float(chi2_quantile(p, float(dof * RUNS))) / RUNS for p in (0.025, 0.975))
    means = np.asarray(values).mean(axis=0)
    return np.mean((means > low) & (means < high)), abs(means.mean() - dof) / dof


# T-57
@pytest.mark.slow
@pytest.mark.parametrize("kind", [ExtendedKalmanFilter, SigmaPointFilter])
def test_consistent_on_poses(drives, kind):
    truth, readings = drives
    filt = kind(*models())

    @jax.jit
    @jax.vmap
    def squared(truth, readings):
        _, history = run(filt, filt.init(prior()), controls(), readings, jnp.ones(STEPS, bool))

        def nees(state, truth):
            error = local(state.mean, truth)
            return error @ jnp.linalg.solve(state.covariance, error)

        return jax.vmap(nees)(history.states, truth), history.infos.nis

    for values, dof in zip(squared(truth, readings), (3, 4), strict=True):
        share, bias = inside(values, dof)
        assert share >= 0.8 and bias < 0.03


@pytest.mark.slow
def test_iterated_update_is_the_most_probable_pose(x64):
    motion, sensor = models()
    filt = ExtendedKalmanFilter(motion, sensor, iterations=8)
    wide = Gaussian(SE2(0.3, -0.2, 0.4), jnp.diag(jnp.array([0.5, 0.4, 0.1])))
    reading = sensor.expect(SE2(1.0, 0.5, -0.1), None)
    state, info = eqx.filter_jit(filt.update)(filt.init(wide), reading, jnp.array(True))

    places, weights = np.asarray(sensor.places), 1.0 / np.array([0.1, 0.1, 0.03, 0.03])
    ranges, bearings = np.asarray(reading[0]), np.asarray(jax.vmap(lambda r: r.angle())(reading[1]))

    def residuals(delta):
        x, y, heading = (float(v) for v in jax.tree.leaves(mean_of(delta)))
        offset = places - [x, y]
        angles = np.arctan2(offset[:, 1], offset[:, 0]) - heading - bearings
        angles = np.arctan2(np.sin(angles), np.cos(angles))
        errors = np.concatenate([np.hypot(*offset.T) - ranges, angles])
        return np.concatenate([delta / np.sqrt([0.5, 0.4, 0.1]), errors * weights])

    @jax.jit
    def pose_of(delta):
        pose = retract(wide.mean, delta)
        return pose.x, pose.y, pose.theta

    def mean_of(delta):
        return pose_of(jnp.asarray(delta))

    best = scipy.optimize.least_squares(residuals, np.zeros(3), xtol=1e-12, ftol=1e-12)
    assert np.allclose(local(wide.mean, state.mean), best.x, atol=1e-6)
    assert info.ok and int(info.dof) == 4


@pytest.fixture(scope="module")
def careful():
    """One update by four filters, of a good and of a wild reading, with gradients."""
    filters = {
        "plain": ExtendedKalmanFilter(*models()),
        "gate": ExtendedKalmanFilter(*models(), gate=0.999),
        "huber": ExtendedKalmanFilter(*models(), loss=Huber()),
        "tukey": ExtendedKalmanFilter(*models(), iterations=2, loss=Tukey()),
    }
    good = models()[1].expect(SE2(0.1, 0.1, 0.05), None)
    wild = (good[0] + jnp.array([20.0, 0.0]), good[1])

    @jax.jit
    def everything(reading):
        states = {name: filt.update(filt.init(prior()), reading, jnp.array(True)) for name, filt in filters.items()}
        return {name: (state.mean, state.covariance, info) for name, (state, info) in states.items()}

    return everything(good), everything(wild)


def test_gate_and_kernels(careful):
    good, wild = careful
    plain = good["plain"][0]
    for name in ("gate", "huber", "tukey"):
        assert np.allclose(local(plain, good[name][0]), 0.0, atol=0.02), name
    truth = SE2(0.1, 0.1, 0.05)
    off = {name: float(jnp.linalg.norm(local(truth, found[0]))) for name, found in wild.items()}
    assert off["plain"] > 1.0 and off["huber"] < 0.2 * off["plain"] and off["tukey"] < 0.2
    _, covariance, info = wild["gate"]
    assert not info.accepted and info.ok and info.log_likelihood == 0.0
    assert np.allclose(covariance, prior().covariance, atol=1e-6)
    assert good["gate"][2].accepted and good["gate"][2].log_likelihood != 0.0


class Beacons(Sensor):
    """Ranges of beacons in the plane."""

    places: jax.Array
    variance: jax.Array

    def expect(self, state, measurement):
        return jnp.sqrt(jnp.sum((self.places - state[None, :2]) ** 2, axis=1))

    def covariance(self, state, measurement):
        return self.variance * jnp.eye(2, dtype=state.dtype)


@pytest.mark.slow
def test_gradients_by_every_array(x64, rng):
    sensor = Beacons(jnp.array([[4.0, 3.0], [-2.0, 5.0]]), jnp.array(0.04))
    model = (ExtendedKalmanFilter(ConstantVelocity(0.3), sensor, iterations=2, loss=Huber()), 0.3 * jnp.eye(4))
    readings = jnp.asarray(np.array([5.0, 5.4]) + 0.5 * rng.normal(size=(6, 2)))

    @eqx.filter_jit
    def total(model):
        filt, spread = model
        _, history = run(filt, filt.init(Gaussian(jnp.zeros(4), spread)), jnp.full(6, 0.5), readings, jnp.ones(6, bool))
        return jnp.sum(history.infos.log_likelihood)

    gradient = eqx.filter_jit(jax.grad(total))(model)
    leaves, structure = jax.tree.flatten(model)
    for i, slope in enumerate(jax.tree.leaves(gradient)):
        way = rng.normal(size=slope.shape)
        way = way + way.T if slope.shape == (4, 4) else way
        moved = [[leaf + h * way if j == i else leaf for j, leaf in enumerate(leaves)] for h in (1e-6, -1e-6)]
        ends = [float(total(jax.tree.unflatten(structure, leaf))) for leaf in moved]
        assert np.isclose(np.sum(np.asarray(slope) * way), (ends[0] - ends[1]) / 2e-6, rtol=1e-5, atol=1e-6)


def test_wrong_options_are_named():
    with pytest.raises(ValueError, match="at least 1 iteration"):
        ExtendedKalmanFilter(*models(), iterations=0)
    with pytest.raises(ValueError, match="probability"):
        ExtendedKalmanFilter(*models(), gate=3.0)
