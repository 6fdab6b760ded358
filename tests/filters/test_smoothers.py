"""Smoothers against the dense posterior of the whole trajectory, in NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

from jaxloc.beliefs import Gaussian, Sensor
from jaxloc.filters import (
    BodyTwist,
    ExtendedKalmanFilter,
    KalmanFilter,
    LinearMotion,
    LinearSensor,
    SigmaPointFilter,
    TwistMotion,
    run,
    run_parallel,
    smooth,
    smooth_fixed_lag,
    smooth_parallel,
)
from jaxloc.filters.parallel.associative_scan import scan_associative
from jaxloc.poses import SE2, local

STEPS, ACTIVE = 14, np.array([1, 1, 1, 0, 1, 1, 1, 1, 1, 1, 1, 0, 0, 1], bool)


def data(seed=0):
    rng = np.random.default_rng(seed)
    transition = np.array([[1.0, 0.3, 0.0], [0.0, 0.9, 0.2], [0.1, 0.0, 0.8]])
    parts = (transition, 0.2 * np.diag([1.0, 2.0, 0.0]), np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 1.0]]), np.eye(2) * 0.5)
    return parts, rng.normal(size=(STEPS, 2)), rng.uniform(size=(STEPS, 2)) < 0.7


def models(parts):
    transition, noise, matrix, sensor_noise = map(jnp.asarray, parts)
    return LinearMotion(transition, noise), LinearSensor(matrix, sensor_noise)


def dense(parts, readings, valid, upto):
    """Posterior means and covariances of all states from the joint normal density, with measurements up to a step."""
    transition, noise, matrix, sensor_noise = parts
    size = 3 * (STEPS + 1)
    effect = np.zeros((size, size))  # of (x0, w1, w2, ...)
    source = np.zeros((size, size))
    for k in range(STEPS + 1):
        rows = slice(3 * k, 3 * k + 3)
        effect[rows, rows] = np.eye(3)
        source[rows, rows] = noise if k else np.eye(3)
        if k:
            there = ACTIVE[k - 1]
            effect[rows] += (transition if there else np.eye(3)) @ effect[3 * k - 3 : 3 * k]
            source[rows, rows] *= there
    covariance = effect @ source @ effect.T
    seen = [(k, i) for k in range(upto + 1) for i in range(2) if valid[k, i] and ACTIVE[k]]
    rows = np.zeros((len(seen), size))
    for row, (k, i) in zip(rows, seen, strict=True):
        row[3 * k + 3 : 3 * k + 6] = matrix[i]
    values = np.array([readings[k, i] for k, i in seen])
    gain = covariance @ rows.T @ np.linalg.inv(rows @ covariance @ rows.T + sensor_noise[0, 0] * np.eye(len(seen)))
    mean, covariance = gain @ values, covariance - gain @ rows @ covariance
    blocks = [slice(3 * k + 3, 3 * k + 6) for k in range(STEPS)]
    return np.array([mean[b] for b in blocks]), np.array([covariance[b, b] for b in blocks])


@pytest.fixture(scope="module")
def results():
    """Every smoother on one recording with gaps, in float64."""
    with jax.enable_x64(True):
        parts, readings, valid = data()
        active = jnp.asarray(ACTIVE)
        filters = {kind.__name__: kind(*models(parts)) for kind in (KalmanFilter, SigmaPointFilter)}

        @jax.jit
        def everything(readings):
            found = {}
            for name, filt in filters.items():
                initial = filt.init(Gaussian(jnp.zeros(3), jnp.eye(3)))
                _, history = run(filt, initial, None, readings, jnp.asarray(valid), active=active)
                found[name] = smooth(filt, history, None, active=active)
            filt = filters["KalmanFilter"]
            initial = filt.init(Gaussian(jnp.zeros(3), jnp.eye(3)))
            whole = run(filt, initial, None, readings, jnp.asarray(valid), active=active)
            found["history"] = whole[1]
            found["lag"] = smooth_fixed_lag(filt, whole[1], None, 3, active=active)
            found["parallel"] = run_parallel(
                filt, initial, None, readings, jnp.asarray(valid), active=active, num_blocks=4
            )[1]
            found["smooth_parallel"] = smooth_parallel(filt, whole[1], None, active=active, num_blocks=4)
            return found

        return everything(jnp.asarray(readings))


def covariances(states):
    roots = np.asarray(states.covariance_sqrt)
    return roots @ roots.transpose(0, 2, 1)


# R-4, T-56, T-57
@pytest.mark.parametrize("name", ["KalmanFilter", "SigmaPointFilter", "smooth_parallel"])
def test_smoothers_equal_the_dense_posterior(results, name):
    means, spreads = dense(*data(), STEPS - 1)
    assert np.allclose(results[name].mean, means, atol=1e-8)
    assert np.allclose(covariances(results[name]), spreads, atol=1e-8)
    assert np.array_equal(results[name].step, np.cumsum(ACTIVE))


def test_fixed_lag_knows_as_much_as_it_should(results):
    for k in range(STEPS):
        means, spreads = dense(*data(), min(k + 3, STEPS - 1))
        assert np.allclose(results["lag"].mean[k], means[k], atol=1e-8)
        assert np.allclose(covariances(results["lag"])[k], spreads[k], atol=1e-8)
    with pytest.raises(ValueError, match="lag"):
        smooth_fixed_lag(KalmanFilter(*models(data()[0])), results["history"], None, -1)


def test_parallel_run_equals_the_sequential_one(results):
    ours, theirs = results["parallel"], results["history"]
    for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        assert np.allclose(a, b, rtol=1e-9, atol=1e-9)


@pytest.mark.slow
def test_parallel_run_in_float32_and_its_gradient():
    parts, readings, valid = data(3)
    filt = KalmanFilter(*models([part.astype(np.float32) for part in parts]))
    initial = filt.init(Gaussian(jnp.zeros(3), jnp.eye(3)))

    def total(readings, runner):
        last, history = runner(filt, initial, None, readings, jnp.asarray(valid))
        return jnp.sum(history.infos.log_likelihood) + jnp.sum(last.mean)

    runners = (run, lambda *args: run_parallel(*args, num_blocks=5))
    pairs = [
        jax.jit(jax.value_and_grad(lambda r, f=f: total(r, f)))(jnp.asarray(readings, jnp.float32)) for f in runners
    ]
    for a, b in zip(*pairs, strict=True):
        assert np.allclose(a, b, rtol=1e-4, atol=1e-4)


def test_associative_scan(rng):
    items = jnp.asarray(rng.normal(size=(6, 2, 2)), jnp.float32)
    forward = scan_associative(lambda a, b: b @ a, items)
    backward = scan_associative(lambda later, earlier: earlier @ later, items, reverse=True)
    expected, back = np.eye(2), np.eye(2)
    for i in range(6):
        expected = np.asarray(items[i]) @ expected
        back = np.asarray(items[5 - i]) @ back
        assert np.allclose(forward[i], expected, atol=1e-4) and np.allclose(backward[5 - i], back, atol=1e-4)


class Fix(Sensor):
    """Position of a pose, read directly."""

    def expect(self, state, measurement):
        return state.translation

    def covariance(self, state, measurement):
        return 0.04 * jnp.eye(2, dtype=state.translation.dtype)


@pytest.mark.slow
def test_iterated_parallel_run_ends_at_the_most_probable_path(x64, rng):
    steps, deviations = 8, np.sqrt([0.01, 0.01, 0.05])
    filt = ExtendedKalmanFilter(TwistMotion(jnp.diag(jnp.asarray(deviations) ** 2)), Fix())
    initial = filt.init(Gaussian(SE2(0.0, 0.0, 0.0), jnp.diag(jnp.array([0.1, 0.1, 0.5]))))
    controls = BodyTwist(jnp.asarray(np.tile([1.0, 0.0, 0.5], (steps, 1))), jnp.ones(steps))
    readings = jnp.asarray(np.cumsum(rng.normal(size=(steps, 2)) * 0.3 + [0.2, 0.7], axis=0))
    last, history = run_parallel(filt, initial, controls, readings, jnp.ones(steps, bool), iterations=15, num_blocks=3)
    sequential = smooth(filt, history, controls)
    path = smooth_parallel(filt, history, controls, num_blocks=3)
    assert np.abs(path.mean.translation - sequential.mean.translation).max() < 0.05  # equal to first order

    @jax.jit
    def residuals(flat):
        poses = jax.vmap(SE2)(*flat.reshape(steps + 1, 3).T)
        before, after = (jax.tree.map(lambda leaf, s=s: leaf[s], poses) for s in (slice(None, -1), slice(1, None)))
        slips = jax.vmap(local)(jax.vmap(filt.motion.move)(before, controls), after) / deviations[None]
        first = local(initial.mean, jax.tree.map(lambda leaf: leaf[0], poses)) / np.sqrt([0.1, 0.1, 0.5])
        return jnp.concatenate([first, slips.ravel(), ((after.translation - readings) / 0.2).ravel()])

    guess = np.concatenate([[[0.0, 0.0, 0.0]], np.c_[readings, np.zeros(steps)]]).ravel()
    guess[2::3] = 1.0
    slope = jax.jit(jax.jacfwd(residuals))
    best = scipy.optimize.least_squares(lambda x: np.asarray(residuals(x)), guess, lambda x: np.asarray(slope(x)))
    assert np.allclose([last.mean.x, last.mean.y, last.mean.theta], best.x[-3:], atol=1e-4)
