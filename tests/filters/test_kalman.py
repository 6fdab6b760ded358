"""Linear filters against plain NumPy in float64, with every kind of mask."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from filterpy.kalman import KalmanFilter as Peer
from scipy.stats import chi2

from jaxloc.beliefs import Gaussian
from jaxloc.filters import (
    ConstantVelocity,
    GaussianState,
    KalmanFilter,
    LinearMotion,
    LinearSensor,
    SigmaPointFilter,
    kalman,
    run,
)
from jaxloc.poses import SE2, local, retract

STEPS = 17


class Model(eqx.Module):
    """Everything that a log likelihood can be differentiated by."""

    filt: KalmanFilter
    prior: Gaussian


def model(dtype=np.float64, seed=0):
    rng = np.random.default_rng(seed)

    def covariance(size):
        a = rng.normal(size=(size, size))
        return jnp.asarray(a @ a.T + 0.1 * np.eye(size), dtype)

    transition = jnp.asarray(0.6 * rng.normal(size=(3, 3)), dtype)
    motion = LinearMotion(transition, covariance(3), jnp.asarray(rng.normal(size=(3, 2)), dtype))
    sensor = LinearSensor(jnp.asarray(rng.normal(size=(2, 3)), dtype), covariance(2))
    return Model(KalmanFilter(motion, sensor), Gaussian(jnp.asarray(rng.normal(size=3), dtype), covariance(3)))


def recording(seed=1, count=None):
    rng = np.random.default_rng(seed)
    lead = () if count is None else (count,)
    controls, readings = rng.normal(size=(*lead, STEPS, 2)), 2.0 * rng.normal(size=(*lead, STEPS, 2))
    return controls, readings, rng.uniform(size=(*lead, STEPS, 2)) < 0.7


def oracle(parts, controls, readings, valid):
    """The textbook filter with the Joseph form; masked rows are deleted."""
    transition, noise, push, matrix, sensor_noise, mean, covariance = (np.asarray(part) for part in parts)
    total, means, covariances = 0.0, [], []
    for control, reading, here in zip(controls, readings, valid, strict=True):
        mean = transition @ mean + push @ control
        covariance = transition @ covariance @ transition.T + noise
        rows, rest = matrix[here], sensor_noise[np.ix_(here, here)]
        if here.any():
            s = rows @ covariance @ rows.T + rest
            error = reading[here] - rows @ mean
            gain = covariance @ rows.T @ np.linalg.inv(s)
            total -= 0.5 * (error @ np.linalg.solve(s, error) + np.linalg.slogdet(2 * np.pi * s)[1])
            mean = mean + gain @ error
            keep = np.eye(3) - gain @ rows
            covariance = keep @ covariance @ keep.T + gain @ rest @ gain.T
        means.append(mean)
        covariances.append(covariance)
    return total, np.array(means), np.array(covariances)


@eqx.filter_jit
def filtered(model, controls, readings, valid, active):
    return run(model.filt, model.filt.init(model.prior), controls, readings, valid, active=active)


@eqx.filter_jit
def score(model, controls, readings, valid, active):
    """Total log likelihood and its gradient by every array of the model."""

    def total(model):
        return jnp.sum(filtered(model, controls, readings, valid, active)[1].infos.log_likelihood)

    return jax.value_and_grad(total)(model)


# R-4, T-56
def test_equals_numpy_and_filterpy(x64):
    here, data = model(), recording()
    last, history = filtered(here, *map(jnp.asarray, data), jnp.ones(STEPS, bool))
    total, means, covariances = oracle(jax.tree.leaves(here), *data)
    assert np.isclose(jnp.sum(history.infos.log_likelihood), total, rtol=1e-10)
    assert np.allclose(history.states.mean, means, atol=1e-10)
    found = history.states.covariance_sqrt @ history.states.covariance_sqrt.mT
    assert np.allclose(found, covariances, atol=1e-10)
    assert np.allclose(last.mean, means[-1], atol=1e-10) and int(last.step) == STEPS
    assert (history.infos.dof == data[2].sum(axis=1)).all() and history.infos.ok.all()

    peer = Peer(3, 2, 2)
    peer.F, peer.Q, peer.B, peer.H, peer.R, mean, peer.P = (np.asarray(part) for part in jax.tree.leaves(here))
    peer.x = mean[:, None]
    for control, reading in zip(*data[:2], strict=True):
        peer.predict(control[:, None])
        peer.update(reading[:, None])
    last, history = filtered(here, *map(jnp.asarray, data[:2]), jnp.ones((STEPS, 2), bool), jnp.ones(STEPS, bool))
    assert np.allclose(last.mean, peer.x[:, 0]) and np.allclose(last.covariance, peer.P)
    assert np.isclose(history.infos.log_likelihood[-1], peer.log_likelihood)
    assert np.isclose(history.infos.nis[-1], peer.mahalanobis**2)
    assert np.allclose(history.infos.innovation_covariance[-1], peer.S)


def test_gradients_by_every_array(x64):
    here, data, everywhere = model(), recording(), jnp.ones(STEPS, bool)
    _, gradient = score(here, *map(jnp.asarray, data), everywhere)
    parts = [np.asarray(part) for part in jax.tree.leaves(here)]
    rng = np.random.default_rng(3)
    for i, slope in enumerate(jax.tree.leaves(gradient)):
        way = rng.normal(size=slope.shape)
        if i in (1, 4, 6):  # covariances stay symmetric
            way = way + way.T
        totals = []
        for h in (1e-5, -1e-5):
            moved = [part + h * way if j == i else part for j, part in enumerate(parts)]
            totals.append(oracle(moved, *data)[0])
        assert np.isclose(np.sum(np.asarray(slope) * way), (totals[0] - totals[1]) / 2e-5, rtol=1e-6, atol=1e-7)


def test_padded_sequences_equal_the_loop(x64):
    here, (controls, readings, valid) = model(), recording(5, 12)
    lengths = np.random.default_rng(6).choice([8, STEPS], 12)
    active = np.arange(STEPS)[None] < lengths[:, None]
    # Padding is invalid on purpose.
    readings = np.where(active[..., None], readings, np.nan)
    controls = np.where(active[..., None], controls, 1e300)
    batch = jax.jit(jax.vmap(lambda *data: score(here, *data)))(*map(jnp.asarray, (controls, readings, valid, active)))
    for i, length in enumerate(lengths):
        cut = [jnp.asarray(part[i, :length]) for part in (controls, readings, valid)]
        alone = score(here, *cut, jnp.ones(length, bool))
        for ours, theirs in zip(jax.tree.leaves(batch), jax.tree.leaves(alone), strict=True):
            assert np.allclose(ours[i], theirs, rtol=1e-10, atol=1e-10)


def test_resumed_run_equals_one_pass(x64):
    here, data = model(), [jnp.asarray(part) for part in recording()]
    there = jnp.ones(STEPS, bool)
    whole, history = filtered(here, *data, there)
    half, first = run(here.filt, here.filt.init(here.prior), *(part[:9] for part in data), active=there[:9])
    end, second = run(here.filt, half, *(part[9:] for part in data), active=there[9:])
    for ours, theirs in zip(jax.tree.leaves(end), jax.tree.leaves(whole), strict=True):
        assert np.allclose(ours, theirs, rtol=1e-13)
    likelihoods = np.concatenate([first.infos.log_likelihood, second.infos.log_likelihood])
    assert np.allclose(likelihoods, history.infos.log_likelihood, rtol=1e-12)


def stiff(dtype, steps, keep=lambda state: state.covariance_sqrt):
    """A vague prior and a precise sensor: ``P0 / R = 1e10``."""
    sensor = LinearSensor(jnp.eye(2, 4, dtype=dtype), 1e-4 * jnp.eye(2, dtype=dtype))
    filt = KalmanFilter(ConstantVelocity(jnp.asarray(1e-2, dtype)), sensor)
    prior = Gaussian(jnp.zeros(4, dtype), 1e6 * jnp.eye(4, dtype=dtype))
    readings = jnp.asarray(np.random.default_rng(0).normal(size=(steps, 2)), dtype)
    return run(filt, filt.init(prior), jnp.full(steps, 1.0, dtype), readings, jnp.ones(steps, bool), keep=keep)[1]


def test_stiff_float32(x64):
    exact, found = (np.asarray(stiff(dtype, 1000).states, float) for dtype in (jnp.float64, jnp.float32))
    exact, found = exact @ exact.transpose(0, 2, 1), found @ found.transpose(0, 2, 1)
    assert np.isfinite(found).all() and np.linalg.eigvalsh(found).min() > 0.0
    error = np.linalg.norm(found - exact, axis=(1, 2)) / np.linalg.norm(exact, axis=(1, 2))
    assert error.max() < 1e-2


def test_long_float32_run_stays_positive():
    roots = np.asarray(stiff(jnp.float32, 100_000).states, float)
    assert np.isfinite(roots).all() and np.diagonal(roots, axis1=1, axis2=2).min() > 0.0
    sample = roots[::97]
    assert np.linalg.eigvalsh(sample @ sample.transpose(0, 2, 1)).min() > 0.0


# Non-finite entries are masked; a finite one whose square overflows makes the update unusable.
@pytest.mark.parametrize(("bad", "ok"), [(np.nan, True), (np.inf, True), (1e30, False)])
def test_nonfinite_and_overflowing_measurements_change_nothing(bad, ok):
    here, (controls, readings, _) = model(np.float32), recording()
    readings[4] = bad
    valid, there = np.ones((STEPS, 2), bool), jnp.ones(STEPS, bool)
    data = [jnp.asarray(part, jnp.float32) for part in (controls, readings)]
    last, history = filtered(here, *data, jnp.asarray(valid), there)
    value, gradient = score(here, *data, jnp.asarray(valid), there)
    assert history.infos.ok.tolist() == [True] * 4 + [ok] + [True] * (STEPS - 5)
    valid[4] = False
    data[1] = jnp.asarray(np.nan_to_num(readings, nan=0.0, posinf=0.0), jnp.float32)
    expected, _ = filtered(here, *data, jnp.asarray(valid), there)
    assert np.allclose(last.mean, expected.mean, atol=1e-5) and history.infos.log_likelihood[4] == 0.0
    for leaf in jax.tree.leaves((last, history, value, gradient)):
        assert np.isfinite(leaf).all()


def test_nothing_valid_leaves_the_state_alone(dtype):
    here = model(dtype)
    state = here.filt.init(here.prior)
    same, info = eqx.filter_jit(here.filt.update)(state, jnp.ones(2, dtype), jnp.zeros(2, bool))
    for ours, theirs in zip(jax.tree.leaves(same), jax.tree.leaves(state), strict=True):
        assert np.array_equal(ours, theirs) and ours.dtype == theirs.dtype
    assert info.log_likelihood == 0.0 and info.ok and info.dof == 0


def test_zero_prior_and_noise_covariance_are_finite():
    sensor = LinearSensor(jnp.eye(1, 2), jnp.zeros((1, 1)))
    filt = KalmanFilter(LinearMotion(jnp.eye(2), jnp.zeros((2, 2))), sensor)

    def after(reading):
        state = filt.predict(filt.init(Gaussian(jnp.zeros(2), jnp.zeros((2, 2)))), None)
        state, info = filt.update(state, reading, jnp.array(True))
        return jnp.sum(state.mean) + jnp.sum(jnp.abs(state.covariance_sqrt)), info

    (value, info), gradient = jax.jit(jax.value_and_grad(after, has_aux=True))(jnp.zeros(1))
    # Each of the three covariances is at the same floor, so that the gain is between zero and one.
    assert bool(info.ok) and float(info.nis) == 0.0 and np.isfinite(info.log_likelihood)
    assert abs(float(value)) < 1e-6 and 0.0 < float(gradient[0]) < 1.0


def test_nonfinite_control_counts_as_zero():
    filt = KalmanFilter(ConstantVelocity(1.0, axes=1), LinearSensor(jnp.eye(1, 2), jnp.eye(1)))
    state = filt.init(Gaussian(jnp.ones(2), jnp.eye(2)))
    moved = filt.predict(state, jnp.array(jnp.nan))
    assert np.allclose(moved.mean, state.mean) and np.allclose(moved.covariance, state.covariance, atol=1e-5)
    assert int(moved.step) == 1


def test_retract_root_transports_a_pose_covariance(x64):
    mean, delta, root = SE2(1.0, 2.0, 0.3), jnp.array([0.5, -0.2, 0.7]), 1e-4 * jnp.eye(3)
    moved, carried = jax.jit(kalman.retract_root)(mean, delta, root)
    draws = np.random.default_rng(0).normal(size=(4000, 3)) * 1e-4
    images = jax.jit(jax.vmap(lambda d: local(moved, retract(mean, delta + d))))(jnp.asarray(draws))
    found = carried @ carried.T
    assert np.allclose(np.cov(np.asarray(images).T), found, atol=0.1 * float(found.max()))
    assert isinstance(GaussianState(moved, carried, jnp.zeros((), jnp.int32)).gaussian(), Gaussian)


# T-56, T-90: means over 200 runs of chi-square values, in float32 as it ships
def test_consistent_over_runs():
    runs, steps, dt = 200, 25, jnp.array(0.5)
    motion, sensor = ConstantVelocity(0.3), LinearSensor(jnp.eye(2, 4), 0.2 * jnp.eye(2))
    filt, prior = KalmanFilter(motion, sensor), Gaussian(jnp.zeros(4), jnp.diag(jnp.array([1.0, 1.0, 0.5, 0.5])))

    def one(key):
        first, second = jax.random.split(key)

        def advance(state, key):
            keys = jax.random.split(key)
            state = motion.sample(state, dt, key=keys[0])
            return state, (state, state[:2] + jnp.sqrt(0.2) * jax.random.normal(keys[1], (2,)))

        truth, readings = jax.lax.scan(advance, prior.sample(1, key=first)[0], jax.random.split(second, steps))[1]
        _, history = run(filt, filt.init(prior), jnp.full(steps, dt), readings, jnp.ones(steps, bool))
        nees = jax.vmap(lambda state, x: state.gaussian().mahalanobis_squared(x))(history.states, truth)
        return nees, history.infos.nis

    nees, nis = jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(4), runs))
    for values, dof in ((nees, 4), (nis, 2)):
        low, high = (chi2.ppf(p, dof * runs) / runs for p in (0.025, 0.975))
        means = np.asarray(values).mean(axis=0)
        assert np.mean((means > low) & (means < high)) >= 0.8
        assert low < means.mean() < high


@pytest.mark.parametrize("kind", [KalmanFilter, SigmaPointFilter])
def test_a_gate_rejects_outliers(kind):
    eye = jnp.eye(2)
    filt = kind(LinearMotion(eye, eye), LinearSensor(eye, eye), gate=0.99)
    state = filt.init(Gaussian(jnp.zeros(2), eye))
    # Variance 2 in each direction: the 99 % region of two of them ends at 9.21.
    for length, passes in ((4.2, True), (4.4, False)):
        after, info = filt.update(state, jnp.array([length, 0.0]), jnp.array(True))
        np.testing.assert_allclose(info.nis, length**2 / 2, rtol=1e-5)
        assert bool(info.accepted) is passes and bool(info.ok)
        assert bool(info.log_likelihood != 0.0) is passes
        np.testing.assert_allclose(after.mean, [length / 2 * passes, 0.0], atol=1e-5)
        np.testing.assert_allclose(after.covariance, (0.5 if passes else 1.0) * np.eye(2), atol=1e-5)
