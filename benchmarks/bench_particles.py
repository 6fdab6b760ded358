"""Particle filters: speed beside `particles` and filterpy, published tables, gradients, localization by a ceiling.

Figures are of systematic resampling at every step, in single precision, with threefry keys.
"""

from collections.abc import Callable, Iterator
from functools import partial

import filterpy.monte_carlo
import jax
import jax.numpy as jnp
import numpy as np
import particles as peer
from particles import distributions as peer_distributions
from particles import state_space_models as peer_models

import jaxloc as jl
from benchmarks.metric import ACCURACY, TIME, Metric, Timing, quickest, timed, versus
from jaxloc.data.simulate.ceiling import drive_below, make_ceiling

_STEPS = 200


class Growth(jl.beliefs.Motion):
    """The univariate nonstationary growth model."""

    noise: jax.Array

    def move(self, state, control):
        """``x / 2 + 25 x / (1 + x^2) + 8 cos(1.2 k)``."""
        return 0.5 * state + 25.0 * state / (1.0 + state**2) + 8.0 * jnp.cos(1.2 * control)

    def covariance(self, state, control):
        """Constant."""
        return self.noise


class Squared(jl.beliefs.Sensor):
    """What is read of the growth model."""

    noise: jax.Array

    def expect(self, state, measurement):
        """``x^2 / 20``."""
        return state**2 / 20.0

    def covariance(self, state, measurement):
        """Constant."""
        return self.noise


class PeerGrowth(peer_models.StateSpaceModel):
    """The growth model of `particles`."""

    def PX0(self):  # noqa: N802
        """Prior."""
        return peer_distributions.Normal(loc=0.1, scale=1.0)

    def PX(self, t, xp):  # noqa: N802
        """Transition."""
        return peer_distributions.Normal(loc=0.5 * xp + 25.0 * xp / (1.0 + xp**2) + 8.0 * np.cos(1.2 * (t - 1)))

    def PY(self, t, xp, x):  # noqa: N802
        """Measurement."""
        return peer_distributions.Normal(loc=x**2 / 20.0)


def metrics(smoke: bool) -> Iterator[Metric]:
    yield from _resamplers(10_000 if smoke else 100_000, 1 if smoke else 20)
    for name, count in (("1e3", 1000), ("1e5", 1000 if smoke else 100_000)):
        yield from _speed(name, count, 1 if smoke else 7)
    yield from _batch(2 if smoke else 100, 1 if smoke else 4)
    yield from _million(10_000 if smoke else 1_000_000, 3 if smoke else 20)
    yield from _tables(smoke)
    yield from _certificate(4 if smoke else 200)
    yield from _ceiling(1 if smoke else 16, smoke)


def _model(q: float = 1.0, r: float = 1.0) -> jl.filters.ParticleFilter:
    motion, sensor = Growth(jnp.full((1, 1), q)), Squared(jnp.full((1, 1), r))
    return jl.filters.ParticleFilter(motion, sensor, ess_threshold=1.0)


def _data(steps: int, seed: int = 0, q: float = 1.0, r: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    rng, states, readings = np.random.default_rng(seed), [], []
    x = 0.1 + np.sqrt(q) * rng.normal()
    for k in range(steps):
        x = 0.5 * x + 25 * x / (1 + x**2) + 8 * np.cos(1.2 * k) + np.sqrt(q) * rng.normal()
        states.append(x)
        readings.append(x**2 / 20 + np.sqrt(r) * rng.normal())
    return np.array(states), np.array(readings)


def _mean(state: jl.filters.ParticleState) -> jax.Array:
    return state.particles.mean()


def _runner(count: int, steps: int) -> Callable[[jax.Array], tuple]:
    """A pass over one recording as a function of the key alone."""
    filt = _model()
    start = filt.init(jl.beliefs.Particles(0.1 + jax.random.normal(jax.random.key(0), (count, 1))))
    readings, valid = jnp.asarray(_data(steps)[1][:, None], jnp.float32), jnp.ones(steps, bool)
    controls = jnp.arange(float(steps))
    return lambda key: jl.filters.run(filt, start, controls, readings, valid, keep=_mean, key=key)


def _resamplers(count: int, repeats: int) -> Iterator[Metric]:
    log_weights = -2.0 * jax.random.normal(jax.random.key(0), (count,)) ** 2
    weights = np.asarray(jax.nn.softmax(log_weights), float)
    for scheme in ("systematic", "stratified", "multinomial", "residual"):
        draw = jax.jit(partial(getattr(jl.beliefs.resampling, scheme), n=count))
        ours = quickest(lambda draw=draw: draw(jax.random.key(1), log_weights), repeats)
        yield Metric(f"particles.{scheme}_1e5", 1e3 * ours.wall, "ms", "lower", TIME)
        if scheme == "systematic":
            theirs = quickest(lambda: filterpy.monte_carlo.systematic_resample(weights), min(repeats, 3))
            yield from versus("particles.systematic_1e5.vs_filterpy", ours, theirs)


def _speed(name: str, count: int, repeats: int) -> Iterator[Metric]:
    run = _runner(count, _STEPS)
    for kind in ("threefry2x32", "unsafe_rbg"):
        key = jax.random.key(1, impl=kind)
        timing = quickest(lambda key=key: run(key), repeats)
        suffix = "" if kind == "threefry2x32" else f".{kind}"
        yield Metric(f"particles.speed_{name}{suffix}", _rate(count, timing), "M particle-steps/s", "higher", TIME)
        if not suffix:
            ours = timing
    readings = list(_data(_STEPS)[1])

    def theirs():
        model = peer_models.Bootstrap(ssm=PeerGrowth(), data=readings)
        filt = peer.SMC(fk=model, N=count, resampling="systematic", ESSrmin=1.0)
        filt.run()
        return filt.logLt

    other = quickest(theirs, max(repeats // 2, 1))
    yield Metric(f"particles.speed_{name}.particles", _rate(count, other), "M particle-steps/s")
    yield from versus(f"particles.speed_{name}.vs_particles", ours, other)


def _rate(count: int, timing: Timing, steps: int = _STEPS) -> float:
    return 1e-6 * count * steps / timing.wall


def _batch(filters: int, repeats: int) -> Iterator[Metric]:
    run = jax.jit(jax.vmap(_runner(1000, _STEPS)))
    keys = jax.random.split(jax.random.key(2), filters)
    timing = quickest(lambda: run(keys), repeats)
    yield Metric("particles.speed_100x1e3", _rate(filters * 1000, timing), "M particle-steps/s", "higher", TIME)


def _million(count: int, steps: int) -> Iterator[Metric]:
    run = _runner(count, steps)
    timing = quickest(lambda: run(jax.random.key(3)), 2)
    yield Metric("particles.million_step", 1e3 * timing.wall / steps, "ms", "lower", TIME)


def _errors(runs: int, steps: int, count: int, q: float, r: float, variance: float, mean: float) -> np.ndarray:
    """Squared errors of the weighted mean on the growth model, over runs and steps."""
    rng, filt = np.random.default_rng(0), _model(q, r)
    x, states, readings = mean + np.sqrt(variance) * rng.normal(size=runs), [], []
    for k in range(steps):
        x = 0.5 * x + 25 * x / (1 + x**2) + 8 * np.cos(1.2 * k) + np.sqrt(q) * rng.normal(size=runs)
        states.append(x)
        readings.append(x**2 / 20 + np.sqrt(r) * rng.normal(size=runs))

    @jax.jit
    @jax.vmap
    def estimate(key, z):
        values = mean + variance**0.5 * jax.random.normal(key, (count, 1))
        state, valid = filt.init(jl.beliefs.Particles(values)), jnp.ones(steps, bool)
        key = jax.random.fold_in(key, 1)
        return jl.filters.run(filt, state, jnp.arange(float(steps)), z, valid, keep=_mean, key=key)[1].states

    found = estimate(
        jax.random.split(jax.random.key(0), runs), jnp.asarray(np.array(readings).T[..., None], jnp.float32)
    )
    return (np.asarray(found)[..., 0] - np.array(states).T) ** 2


def _tables(smoke: bool) -> Iterator[Metric]:
    toolbox = _errors(2 if smoke else 100, 50 if smoke else 500, 1000, 1.0, 1.0, 1.0, 0.1)
    yield Metric("particles.growth_mse", float(toolbox.mean()), "1 (table: 10.2)", "lower", ACCURACY)
    sir = _errors(10 if smoke else 2000, 100, 50, 10.0, 1.0, 10.0, 0.0)
    yield Metric("particles.growth_rmse_sir50", float(np.sqrt(sir.mean())), "1 (table: 5.54)", "lower", ACCURACY)


def _certificate(repetitions: int) -> Iterator[Metric]:
    """The score of an AR(1) model, 33.609 by a Kalman filter, as the mean over repetitions of the filter's gradient."""
    rng, x, readings = np.random.default_rng(0), 0.0, []
    for _ in range(100):
        x = 0.9 * x + rng.normal()
        readings.append([x + 0.5 * rng.normal()])
    readings, valid = jnp.asarray(readings, jnp.float32), jnp.ones(100, bool)
    eye = jnp.eye(1)

    def log_likelihood(a, key, proposal):
        motion, sensor = jl.filters.LinearMotion(a * eye, eye), jl.filters.LinearSensor(eye, 0.25 * eye)
        filt = jl.filters.ParticleFilter(motion, sensor, proposal=proposal, ess_threshold=1.0)
        state = filt.init(jl.beliefs.Particles(jnp.zeros((200, 1))))
        return jl.filters.run(filt, state, None, readings, valid, key=key)[1].infos.log_likelihood.sum()

    keys = jax.random.split(jax.random.key(0), repetitions)
    for name, proposal in (("score", jl.filters.Bootstrap()), ("score_guided", jl.filters.Guided())):
        forward = jax.jit(jax.vmap(lambda key, p=proposal: log_likelihood(jnp.float32(0.8), key, p)))
        slope = jax.grad(lambda a, key, p=proposal: log_likelihood(a, key, p))
        slope = jax.jit(jax.vmap(slope, in_axes=(None, 0)))
        found = np.asarray(slope(jnp.float32(0.8), keys), float)
        yield Metric(f"particles.{name}", float(found.mean()), "1 (exact: 33.609)", "equal", ACCURACY)
        yield Metric(f"particles.{name}_sd", float(found.std()), "1", "lower", 3 * ACCURACY)
        backward = timed(lambda s=slope: s(jnp.float32(0.8), keys))[1].wall
        ratio = backward / quickest(lambda f=forward: f(keys), 2).wall
        yield Metric(f"particles.{name}_cost", ratio, "x of the value", "lower")


def _ceiling(drives: int, smoke: bool) -> Iterator[Metric]:
    """Localization in a museum of 40 by 60 m by one pixel that looks up."""
    museum = make_ceiling(0)

    def drive(**options):
        driven = [drive_below(museum, seed, **options) for seed in range(drives)]
        return jax.tree.map(lambda *leaves: jnp.stack(leaves), *driven)

    def locate(prior, noise, sigma, driven):
        motion = jl.sensors.OdometryMotion(
            turn_turn=0.05, turn_drive=noise, drive_drive=noise, drive_turn=0.01, turn_floor=0.002, drive_floor=0.003
        )
        filt = jl.filters.ParticleFilter(motion, jl.sensors.CeilingSensor(museum, sigma))

        def one(driven, key):
            state, valid = filt.init(prior(driven, key)), jnp.ones(driven.brightness.shape, bool)
            arguments = (state, driven.odometry, driven.brightness, valid)
            return jl.filters.run(filt, *arguments, keep=lambda s: _mean(s).translation, key=key)[1].states

        found = jax.jit(lambda d, k: jax.lax.map(lambda pair: one(*pair), (d, k)))(
            driven, jax.random.split(jax.random.key(0), drives)
        )
        return np.linalg.norm(np.asarray(found) - np.asarray(driven.poses.translation), axis=-1)

    def near(driven, key):
        spread = jnp.diag(jnp.array([0.01, 0.01, 0.0025]))
        return jl.beliefs.Particles.from_gaussian(jl.beliefs.Gaussian(driven.start, spread), 1000, key=key)

    def anywhere(driven, key):
        return jl.beliefs.Particles.uniform_planar(museum.origin, museum.upper, 40_000, key=key)

    tracked = locate(near, 0.05, 0.05, drive(distance=5.0 if smoke else 200.0, step=0.1))
    yield Metric("particles.ceiling_track_end", float(np.median(tracked[:, -1])), "m (bar: 0.1)", "lower", ACCURACY)
    yield Metric(
        "particles.ceiling_track_within_10cm", float(np.mean(tracked[:, -1] < 0.1)), "part", "higher", ACCURACY
    )
    found = locate(anywhere, 0.1, 0.08, drive(distance=2.4 if smoke else 75.6, step=0.6))
    yield Metric("particles.ceiling_found_in_126", float(np.mean(found[:, -1] < 0.5)), "part", "higher", ACCURACY)
