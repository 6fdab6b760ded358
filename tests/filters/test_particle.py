import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array

from jaxloc.beliefs import Gaussian, KLDSize, Motion, Particles, Sensor
from jaxloc.beliefs.resampling.strategies import OptimalTransport, Soft
from jaxloc.filters import Auxiliary, Bootstrap, Guided, ParticleFilter, run
from jaxloc.poses import SE2, SO2


class Growth(Motion):
    """The univariate nonstationary growth model: ``x / 2 + 25 x / (1 + x^2) + 8 cos(1.2 k)``."""

    noise: Array

    def move(self, state, control):
        return 0.5 * state + 25.0 * state / (1.0 + state**2) + 8.0 * jnp.cos(1.2 * control)

    def covariance(self, state, control):
        return self.noise


class Squared(Sensor):
    """``x^2 / 20``."""

    noise: Array

    def expect(self, state, measurement):
        return state**2 / 20.0

    def covariance(self, state, measurement):
        return self.noise


class Decay(Motion):
    """``a x``."""

    a: Array

    def move(self, state, control):
        return self.a * state

    def covariance(self, state, control):
        return jnp.eye(1, dtype=state.dtype)


class Direct(Sensor):
    """``x``."""

    variance: float

    def expect(self, state, measurement):
        return state

    def covariance(self, state, measurement):
        return self.variance * jnp.eye(1, dtype=state.dtype)


def growth(runs, steps, seed, q, r, start_variance, initial=0.0):
    rng = np.random.default_rng(seed)
    x = initial + np.sqrt(start_variance) * rng.normal(size=runs)
    states, readings = [], []
    for k in range(steps):
        x = 0.5 * x + 25 * x / (1 + x**2) + 8 * np.cos(1.2 * k) + np.sqrt(q) * rng.normal(size=runs)
        states.append(x)
        readings.append(x**2 / 20 + np.sqrt(r) * rng.normal(size=runs))
    return np.array(states).T, np.array(readings).T


def growth_errors(runs, steps, particles, seed, q, r, start_variance, initial=0.0):
    """Squared errors of the weighted mean, over runs and steps."""
    states, readings = growth(runs, steps, seed, q, r, start_variance, initial)
    filt = ParticleFilter(Growth(jnp.full((1, 1), q)), Squared(jnp.full((1, 1), r)), ess_threshold=1.0)

    @jax.jit
    @jax.vmap
    def estimate(key, z):
        first, rest = jax.random.split(key)
        prior = Gaussian(jnp.full(1, initial), jnp.full((1, 1), start_variance))
        state = filt.init(Particles.from_gaussian(prior, particles, key=first))
        controls, valid = jnp.arange(float(steps)), jnp.ones(steps, bool)
        return run(filt, state, controls, z, valid, keep=lambda s: s.particles.mean(), key=rest)[1].states

    found = estimate(jax.random.split(jax.random.key(seed), runs), jnp.asarray(readings[..., None], jnp.float32))
    return (np.asarray(found)[..., 0] - states) ** 2


@pytest.mark.slow
def test_growth_model_table_of_the_toolbox():  # bootstrap, 1000 particles, 100 runs of 500 steps: 10.2
    errors = growth_errors(100, 500, 1000, 0, 1.0, 1.0, 1.0, 0.1)
    assert abs(errors.mean() - 10.2) < 0.4


@pytest.mark.slow
def test_growth_model_table_of_arulampalam():  # SIR, 50 particles: 5.54
    errors = growth_errors(2000, 100, 50, 0, 10.0, 1.0, 10.0)
    assert abs(np.sqrt(errors.mean()) - 5.54) < 0.1


def decay_readings(steps):
    """A path of ``x' = 0.9 x + w`` from zero, read with a standard deviation of a half."""
    rng, x, readings = np.random.default_rng(0), 0.0, []
    for _ in range(steps):
        x = 0.9 * x + rng.normal()
        readings.append(x + 0.5 * rng.normal())
    return np.array(readings)


def exact(a, readings, noise=0.25):
    """Log likelihood of the readings by a Kalman filter in double precision."""
    mean = variance = total = 0.0
    for reading in readings:
        mean, variance = a * mean, a * a * variance + 1.0
        total_variance = variance + noise
        total -= 0.5 * ((reading - mean) ** 2 / total_variance + np.log(2 * np.pi * total_variance))
        mean, variance = (
            mean + variance / total_variance * (reading - mean),
            variance * noise / total_variance,
        )
    return total


def log_likelihood(a, key, readings, particles, noise=0.25, **options):
    filt = ParticleFilter(Decay(a), Direct(noise), **options)
    state = filt.init(Particles(jnp.zeros((particles, 1), readings.dtype)))
    valid = jnp.ones(readings.shape[0], bool)
    return run(filt, state, None, readings[:, None], valid, key=key)[1].infos.log_likelihood.sum()


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        {"ess_threshold": 1.0},
        {"ess_threshold": 0.5},
        {"ess_threshold": 0.7, "proposal": Guided()},
        {"ess_threshold": 0.9, "proposal": Auxiliary(guided=True)},
        {"ess_threshold": 1.0, "proposal": Auxiliary(), "noise": 2.0},
        {"ess_threshold": 0.7, "resampling": Soft(0.5)},
    ],
    ids=["always", "conditional", "guided", "adapted", "auxiliary", "soft"],
)
def test_evidence_is_unbiased(options):
    readings = decay_readings(12)
    few = jnp.asarray(readings, jnp.float32)
    keys = jax.random.split(jax.random.key(1), 1000)
    found = jax.jit(jax.vmap(lambda key: log_likelihood(jnp.float32(0.8), key, few, 60, **options)))(keys)
    ratio = np.exp(np.float64(found) - exact(0.8, readings, options.get("noise", 0.25)))
    assert abs(ratio.mean() - 1.0) / (ratio.std() / np.sqrt(1000)) < 3.0
    assert ratio.std() / np.sqrt(1000) < 0.1


def score_runs(count, particles, seed, **options):
    readings = jnp.asarray(decay_readings(100), jnp.float32)
    slope = jax.grad(lambda a, key: log_likelihood(a, key, readings, particles, **options))
    keys = jax.random.split(jax.random.key(seed), count)
    return np.float64(jax.jit(jax.vmap(slope, in_axes=(None, 0)))(jnp.float32(0.8), keys))


@pytest.mark.slow
def test_gradient_certificate():
    readings = decay_readings(100)
    score = (exact(0.8 + 1e-5, readings) - exact(0.8 - 1e-5, readings)) / 2e-5
    assert abs(score - 33.609) < 1e-3
    found = score_runs(200, 200, 0, ess_threshold=1.0)
    assert abs(found.mean() - score) < 2.0 * found.std() / np.sqrt(200)
    assert found.std() < 4.5


@pytest.mark.slow
def test_no_gradient_is_lost_in_single_precision():
    assert np.all(np.isfinite(score_runs(1000, 30, 3)))


@pytest.mark.slow
def test_guided_gradient_along_the_particles():
    score = (exact(0.8 + 1e-5, decay_readings(100)) - exact(0.8 - 1e-5, decay_readings(100))) / 2e-5
    found = score_runs(100, 200, 0, proposal=Guided(), pathwise=True)
    assert abs(found.mean() - score) < 3.0 * found.std() / np.sqrt(100) and found.std() < 2.5


@pytest.mark.slow
@pytest.mark.parametrize("resampling", [Soft(), OptimalTransport(iterations=8)], ids=["soft", "transport"])
def test_biased_gradients_are_finite(resampling):
    readings = jnp.asarray(decay_readings(10), jnp.float32)
    slope = jax.value_and_grad(lambda a, key: log_likelihood(a, key, readings, 40, resampling=resampling))
    keys = jax.random.split(jax.random.key(0), 100)
    values, slopes = jax.jit(jax.vmap(slope, in_axes=(None, 0)))(jnp.float32(0.8), keys)
    assert bool(jnp.all(jnp.isfinite(slopes)))
    assert abs(float(values.mean()) - exact(0.8, decay_readings(10))) < 2.0


@pytest.fixture(scope="module")
def tracked():
    """A filter on the growth model, and one step of it that many tests share."""
    filt = ParticleFilter(Growth(jnp.full((1, 1), 1.0)), Squared(jnp.full((1, 1), 1.0)))
    state = filt.init(Particles(jnp.linspace(-3.0, 3.0, 64)[:, None]))
    return filt, filt.predict(state, jnp.array(0.0), key=jax.random.key(0))


def assert_same(one, other):
    assert all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True))


def test_no_measurement_changes_nothing(tracked):
    filt, state = tracked
    after, info = filt.update(state, jnp.ones(1), jnp.array(False))
    assert_same(after, state)
    assert float(info.log_likelihood) == 0.0 and bool(info.ok)
    after, info = filt.update(state, jnp.full(1, jnp.nan), jnp.array(True))
    assert float(info.log_likelihood) == pytest.approx(0.0, abs=1e-6) and bool(info.ok)
    assert np.allclose(after.particles.values, state.particles.values)


def test_impossible_measurement_keeps_and_inflates_the_particles(tracked):
    class Never(Squared):
        def log_prob(self, state, measurement, valid):
            return jnp.full((), -jnp.inf)

    filt, state = tracked
    never = ParticleFilter(filt.motion, Never(filt.sensor.noise))
    after, info = never.update(state, jnp.ones(1), jnp.array(True))
    assert not info.ok and np.isfinite(info.log_likelihood) and float(info.log_likelihood) < -80.0
    assert np.isclose(info.ess, 64.0)
    before, wide = state.particles, after.particles
    assert np.allclose(wide.mean(), before.mean(), atol=1e-4)
    assert 1.2 < float(wide.covariance()[0, 0] / before.covariance()[0, 0]) < 3.0
    slope = jax.grad(lambda z: filt.update(state, z, jnp.array(True))[1].log_likelihood)(jnp.full(1, 1e30))
    assert bool(jnp.all(jnp.isfinite(slope)))


def test_padded_steps_and_resumed_runs(tracked):
    filt, initial = tracked
    readings = jnp.asarray(growth(1, 12, 1, 1.0, 1.0, 1.0)[1][0][:, None], jnp.float32)
    controls, valid, key = jnp.arange(1.0, 13.0), jnp.ones(12, bool), jax.random.key(4)
    active = jnp.arange(12) < 6
    end, history = run(filt, initial, controls, readings, valid, key=key)
    half, first = run(filt, initial, controls, readings.at[8].set(jnp.nan), valid, active=active, key=key)
    assert np.array_equal(first.infos.log_likelihood[:6], history.infos.log_likelihood[:6])
    assert int(half.step) == int(initial.step) + 6
    shift = jnp.roll(jnp.arange(12), -6)
    resumed, _ = run(filt, half, controls[shift], readings[shift], valid, active=active, key=key)
    assert_same(resumed, end)


def test_weights_collapse_without_resampling():
    readings = jnp.asarray(decay_readings(30), jnp.float32)

    def sizes(threshold):
        filt = ParticleFilter(Decay(jnp.float32(0.9)), Direct(0.25), ess_threshold=threshold)
        state, valid = filt.init(Particles(jnp.zeros((500, 1)))), jnp.ones(30, bool)
        return run(filt, state, None, readings[:, None], valid, key=jax.random.key(0))[1].infos

    never, often = sizes(0.0), sizes(0.5)
    assert float(never.ess[-1]) < 10.0 and not bool(jnp.any(never.resampled))
    assert float(often.ess.min()) > 20.0 and bool(jnp.any(often.resampled))


def test_two_modes_stay(tracked):  # where a normal density has one mode, in the wrong place
    filt, _ = tracked
    prior = Particles.from_gaussian(Gaussian(jnp.array([0.3]), jnp.eye(1) * 25.0), 4000, key=jax.random.key(0))
    state, _ = filt.update(filt.init(prior), jnp.array([5.0]), jnp.array(True))  # x = +-10
    weights, x = np.asarray(state.particles.weights), np.asarray(state.particles.values)[:, 0]
    grid = np.linspace(-25, 25, 20001)
    density = np.exp(-0.5 * (grid - 0.3) ** 2 / 25.0 - 0.5 * (grid**2 / 20.0 - 5.0) ** 2)
    density /= density.sum()
    assert abs(weights[x > 0].sum() - density[grid > 0].sum()) < 0.06
    assert abs(weights @ x**2 - density @ grid**2) < 0.05 * (density @ grid**2)
    mean = float(state.particles.mean()[0])
    assert density[np.abs(grid - mean) < 0.5].sum() < 0.02  # no truth where the mean is
    near = float(state.particles.local_mean(jnp.array([2.0]))[0])
    assert 6.5 < abs(near) < 10.5


class Bearings(Sensor):
    """Directions to landmarks from a planar pose."""

    landmarks: Array

    def expect(self, state, measurement):
        seen = state.inverse().apply(self.landmarks)
        return jax.vmap(SO2.from_angle)(jnp.arctan2(seen[:, 1], seen[:, 0]))

    def covariance(self, state, measurement):
        return jnp.eye(3, dtype=self.landmarks.dtype) * 0.02**2


class Drive(Motion):
    """A relative pose, with noise."""

    noise: Array

    def move(self, state, control):
        return state @ control

    def covariance(self, state, control):
        return jnp.diag(self.noise)


@pytest.mark.parametrize("proposal", [Bootstrap(), Guided()], ids=["bootstrap", "guided"])
def test_bearings_locate_a_pose(proposal):
    path, (x, y, theta) = [], (1.0, 0.0, 0.0)
    for _ in range(20):
        x, y, theta = x + 0.5 * np.cos(theta), y + 0.5 * np.sin(theta), theta + 0.1
        path.append((x, y, theta))
    path, landmarks = np.array(path), np.array([[5.0, 0.0], [0.0, 5.0], [-4.0, -4.0]])
    offset = landmarks[None] - path[:, None, :2]
    bearing = np.arctan2(offset[..., 1], offset[..., 0]) - path[:, 2:]
    readings = SO2.identity(), jnp.asarray(np.cos(bearing), jnp.float32), jnp.asarray(np.sin(bearing), jnp.float32)
    readings = jax.tree.unflatten(jax.tree.structure(readings[0]), readings[1:])
    steps = jnp.broadcast_to(jnp.array([0.5, 0.0, 0.1]), (20, 3))

    @jax.jit
    def locate(key):
        filt = ParticleFilter(Drive(jnp.array([2e-3, 2e-3, 1e-3])), Bearings(jnp.asarray(landmarks)), proposal=proposal)
        prior = Gaussian(SE2(0.8, 0.2, 0.1), jnp.eye(3) * 0.1)
        state = filt.init(Particles.from_gaussian(prior, 400, key=key))
        controls = jax.vmap(SE2)(*steps.T)
        state, history = run(filt, state, controls, readings, jnp.ones(20, bool), key=key)
        mean = state.particles.mean()
        return mean.translation, mean.theta, history.infos

    position, heading, infos = locate(jax.random.key(0))
    assert bool(jnp.all(infos.ok))
    assert np.hypot(*(np.asarray(position) - path[-1, :2])) < 0.1 and abs(float(heading) - path[-1, 2]) < 0.03


def test_double_precision_stays(x64):
    filt = ParticleFilter(Decay(jnp.asarray(0.9)), Direct(0.25), proposal=Auxiliary(guided=True))
    state = filt.init(Particles(jnp.zeros((50, 1))))
    end, history = run(filt, state, None, jnp.ones((3, 1)), jnp.ones(3, bool), key=jax.random.key(0))
    floating = [leaf for leaf in jax.tree.leaves((end, history)) if jnp.issubdtype(leaf.dtype, jnp.floating)]
    assert {leaf.dtype for leaf in floating} == {np.dtype("float64")} and end.step.dtype == jnp.int32


def test_adaptive_sizes(tracked):
    size = KLDSize(jnp.array([0.5]), minimum=32)
    filt = ParticleFilter(tracked[0].motion, tracked[0].sensor, ess_threshold=1.0, adaptive=size)
    readings = jnp.asarray(growth(1, 20, 5, 1.0, 1.0, 1.0)[1][0][:, None], jnp.float32)
    state = filt.init(Particles.uniform(jnp.full(1, -20.0), jnp.full(1, 20.0), 2048, key=jax.random.key(0)))
    state, history = run(filt, state, jnp.arange(20.0), readings, jnp.ones(20, bool), key=jax.random.key(1))
    counts = np.asarray(history.infos.count)
    assert counts.max() < 2048 and counts.min() >= 32 and len(set(counts.tolist())) > 5
    assert np.isclose(float(state.particles.weights.sum()), 1.0, atol=1e-5)
    assert int(state.particles.valid.sum()) == counts[-1]


def test_batches_equal_loops(tracked):
    filt, state = tracked
    keys = jax.random.split(jax.random.key(0), 3)

    def step(key):
        moved = filt.predict(state, jnp.array(1.0), key=key)
        after, info = filt.update(moved, jnp.ones(1), jnp.array(True))
        return after.particles.mean(), info.log_likelihood, after.ancestors

    batch, loop = jax.vmap(step)(keys), [step(key) for key in keys]
    for i in range(3):
        assert all(np.allclose(a[i], b, atol=1e-5) for a, b in zip(batch, loop[i], strict=True))


def test_wrong_use_is_refused(tracked):
    filt, state = tracked
    with pytest.raises(TypeError, match="from_gaussian"):
        filt.init(Gaussian(jnp.zeros(1), jnp.eye(1)))
    with pytest.raises(ValueError, match="key"):
        filt.predict(state, jnp.array(0.0))
    ahead = ParticleFilter(filt.motion, filt.sensor, proposal=Auxiliary())
    with pytest.raises(ValueError, match="key"):
        ahead.update(ahead.init(state.particles), jnp.ones(1), jnp.array(True))
