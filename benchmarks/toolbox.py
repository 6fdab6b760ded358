"""The scenarios of the EKF/UKF toolbox, whose tables are published: Monte Carlo errors of our filters on them.

References:
    Hartikainen, Solin and Särkkä, *Optimal Filtering with Kalman Filters and Smoothers: a Manual for the Matlab toolbox
    EKF/UKF*, 2011, chapters 3 and 4.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import jaxloc as jl
from jaxloc.beliefs import Gaussian, Motion, Sensor
from jaxloc.filters import (
    ConstantAcceleration,
    ConstantVelocity,
    CoordinatedTurn,
    Cubature,
    ExtendedKalmanFilter,
    GaussHermite,
    InteractingMultipleModel,
    InteractingState,
    KalmanFilter,
    LinearSensor,
    SigmaPointFilter,
    Unscented,
    run,
    smooth,
    smooth_interacting,
)


class Score(NamedTuple):
    """A mean over runs, and its standard error."""

    mean: float
    error: float


class Growth(Motion):
    """The univariate nonstationary growth model; the control is the number of the step."""

    def move(self, state: Any, control: Any) -> Any:
        """One step."""
        return 0.5 * state + 25.0 * state / (1.0 + state**2) + 8.0 * jnp.cos(1.2 * (control - 1.0))

    def covariance(self, state: Any, control: Any) -> Any:
        """Unit noise."""
        return jnp.eye(1, dtype=state.dtype)


class Square(Sensor):
    """``x^2 / 20`` with unit noise."""

    def expect(self, state: Any, measurement: Any) -> Any:
        """The reading."""
        return state**2 / 20.0

    def covariance(self, state: Any, measurement: Any) -> Any:
        """Unit noise."""
        return jnp.eye(1, dtype=state.dtype)


class Bearings(Sensor):
    """Directions in which two stations see a target, as rotations."""

    stations: Array
    sigma: float

    def expect(self, state: Any, measurement: Any) -> Any:
        """The directions."""
        offset = state[None, :2] - self.stations.astype(state.dtype)
        return jax.vmap(jl.poses.SO2.from_angle)(jnp.arctan2(offset[:, 1], offset[:, 0]))

    def covariance(self, state: Any, measurement: Any) -> Any:
        """Independent noise."""
        return self.sigma**2 * jnp.eye(2, dtype=state.dtype)


class Reentry(Motion):
    """A vehicle that falls into the atmosphere, km and s; Euler steps of the control's length."""

    intensity: Array

    def move(self, state: Any, control: Any) -> Any:
        """One step."""
        position, velocity = state[:2], state[2:4]
        radius, speed = jnp.linalg.norm(position), jnp.linalg.norm(velocity)
        drag = -0.59783 * jnp.exp(state[4]) * jnp.exp((6374.0 - radius) / 13.406) * speed
        pull = -3.9860e5 / radius**3
        rate = jnp.concatenate([velocity, drag * velocity + pull * position, jnp.zeros_like(state[:1])])
        return state + control * rate

    def covariance(self, state: Any, control: Any) -> Any:
        """Noise of the velocities and the drag."""
        return jnp.diag(self.intensity.astype(state.dtype)) * control


class Radar(Sensor):
    """Range (km) and bearing from a station."""

    def expect(self, state: Any, measurement: Any) -> Any:
        """The reading."""
        east, north = state[0] - 6374.0, state[1]
        return jnp.stack([jnp.hypot(east, north), jnp.arctan2(north, east)])

    def covariance(self, state: Any, measurement: Any) -> Any:
        """One meter and 0.17 mrad."""
        return jnp.diag(jnp.array([1e-3, 0.17e-3], state.dtype) ** 2)


def ungm(runs: int, steps: int = 500, seed: int = 0) -> dict[str, Score]:
    """Mean squared errors on the growth model."""
    motion, sensor = Growth(), Square()
    controls = jnp.arange(1.0, steps + 1.0)
    truth, readings = simulate(motion, sensor, Gaussian(jnp.array([0.1]), jnp.eye(1)), controls, runs, seed)
    filters = {
        "ekf": ExtendedKalmanFilter(motion, sensor),
        "ukf": SigmaPointFilter(motion, sensor, Unscented(0.5, 2.0, 2.0)),
        "ckf": SigmaPointFilter(motion, sensor, Cubature()),
        "ghkf": SigmaPointFilter(motion, sensor, GaussHermite(10)),
    }
    prior = Gaussian(jnp.array([0.1]), jnp.eye(1))
    return _scores(filters, prior, controls, readings, lambda path: jnp.mean((path - truth)[..., 0] ** 2, axis=1))


def bearings(runs: int, seed: int = 0, prior_variances: tuple[float, ...] = (0.1, 0.1, 10.0, 10.0)) -> dict[str, Score]:
    """Root mean squared errors of position with two bearings-only stations."""
    rng = np.random.default_rng(seed)
    dt, steps = 0.01, 500
    turn = np.zeros((runs, steps))
    for first in (49, 199, 349):
        turn[:, first : first + 51] = np.pi / 2 / 51 / dt + 0.01 * rng.normal(size=(runs, 51))
    # The exact solution for a constant turn rate, clockwise.
    heading = np.cumsum(-turn * dt, axis=1) + 0.5 * turn * dt
    stretch = np.sinc(0.5 * turn * dt / np.pi)[..., None]
    truth = np.cumsum(dt * stretch * np.stack([np.cos(heading), np.sin(heading)], axis=-1), axis=1)
    stations = np.array([[-1.0, -2.0], [1.0, 1.0]])
    offset = truth[:, :, None] - stations
    angles = jnp.asarray(np.arctan2(offset[..., 1], offset[..., 0]) + 0.05 * rng.normal(size=(runs, steps, 2)), float)
    readings = jax.vmap(jax.vmap(jax.vmap(jl.poses.SO2.from_angle)))(angles)
    motion, sensor = ConstantVelocity(0.1), Bearings(jnp.asarray(stations, float), 0.05)
    filters = {
        "ekf": ExtendedKalmanFilter(motion, sensor),
        "ukf": SigmaPointFilter(motion, sensor, Unscented(kappa=-1.0)),
        "ckf": SigmaPointFilter(motion, sensor, Cubature()),
        "ghkf": SigmaPointFilter(motion, sensor, GaussHermite(3)),
    }
    prior = Gaussian(jnp.zeros(4), jnp.diag(jnp.array(prior_variances)))
    return _scores(filters, prior, jnp.full(steps, dt), readings, _position_errors(jnp.asarray(truth, float)))


def reentry(runs: int, seed: int = 0) -> dict[str, Score]:
    """Root mean squared errors of position, km, of the re-entry vehicle; in float64."""
    dt, steps = 0.1, 2000
    start = jnp.array([6500.4, 349.14, -1.8093, -6.7967, 0.0])
    noise = jnp.array([0.0, 0.0, 2.4064e-4, 2.4064e-4, 0.0])
    truth_motion, sensor = Reentry(noise), Radar()
    controls = jnp.full(steps, dt)
    birth = Gaussian(start.at[4].set(0.6932), 1e-6 * jnp.diag(jnp.array([1.0, 1.0, 1.0, 1.0, 0.0])))
    truth, readings = simulate(truth_motion, sensor, birth, controls, runs, seed)
    motion = Reentry(noise.at[4].set(1e-5))
    filters = {
        "ekf": ExtendedKalmanFilter(motion, sensor),
        "ukf": SigmaPointFilter(motion, sensor, Unscented(kappa=-2.0)),
        "ckf": SigmaPointFilter(motion, sensor, Cubature()),
    }
    prior = Gaussian(start, jnp.diag(jnp.array([1e-6, 1e-6, 1e-6, 1e-6, 1.0])))
    return _scores(filters, prior, controls, readings, _position_errors(truth[..., :2]))


def reentry_means(runs: str) -> dict[str, float]:
    """The means alone, for a process of its own."""
    return {key: score.mean for key, score in reentry(int(runs)).items()}


def maneuvers(runs: int, seed: int = 0, *, whole: bool = True) -> dict[str, Score]:
    """Mean squared errors of position when acceleration sets in and ends; of the bank's filter alone unless whole."""
    rng = np.random.default_rng(seed)
    dt, steps = 0.1, 200
    models = (ConstantVelocity(0.01, padding=2), ConstantAcceleration(1.0))
    wild = np.zeros(steps, int)
    wild[50:70] = wild[120:150] = 1
    discrete = [_discrete(model, 6, dt) for model in models]
    truth = np.zeros((runs, steps, 6))
    truth[:, 0, 3] = -1.0
    for i in range(1, steps):
        transition, root = discrete[wild[i]]
        truth[:, i] = truth[:, i - 1] @ transition.T + rng.normal(size=(runs, 6)) @ root.T
    readings = jnp.asarray(truth[..., :2] + np.sqrt(0.1) * rng.normal(size=(runs, steps, 2)), float)
    sensor = LinearSensor(jnp.eye(2, 6), 0.1 * jnp.eye(2))
    filters = tuple(KalmanFilter(model, sensor) for model in models)
    bank = InteractingMultipleModel(filters, jnp.array([[0.98, 0.02], [0.02, 0.98]]))
    mean = jnp.array([0.0, 0.0, 0.0, -1.0, 0.0, 0.0])
    priors = [Gaussian(mean, 0.1 * jnp.diag(jnp.array([1.0, 1.0, 1.0, 1.0, a, a]))) for a in (0.0, 5.0)]
    error = _squared_errors(jnp.asarray(truth[..., :2], float))
    scores = {}
    for name, filt, prior in zip(("kf1", "kf2"), filters, priors, strict=True) if whole else ():
        scores |= _scores({name: filt}, prior, jnp.full(steps, dt), readings, error)
    return scores | _modes_scores("imm", bank, priors, (0.9, 0.1), jnp.full(steps, dt), readings, error, whole)


def turns(runs: int, seed: int = 0) -> dict[str, Score]:
    """Mean squared errors of position on a path with two turns."""
    rng = np.random.default_rng(seed)
    dt, steps = 0.1, 200
    rate = np.zeros(steps)
    rate[40:90], rate[110:160] = 1.0, -1.0
    heading = np.cumsum(rate * dt) - 0.5 * rate * dt
    stretch = np.sinc(0.5 * rate * dt / np.pi)[:, None]
    moves = dt * stretch * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    truth = np.cumsum(moves, axis=0) - moves[0]
    readings = jnp.asarray(truth + np.sqrt(0.05) * rng.normal(size=(runs, steps, 2)), float)
    sensor = LinearSensor(jnp.eye(2, 5), 0.05 * jnp.eye(2))
    straight, turn = KalmanFilter(ConstantVelocity(0.01, padding=1), sensor), CoordinatedTurn(0.0, 0.15)
    chain = jnp.array([[0.9, 0.1], [0.1, 0.9]])
    banks = {
        "eimm": InteractingMultipleModel((straight, ExtendedKalmanFilter(turn, sensor)), chain),
        "uimm": InteractingMultipleModel((straight, SigmaPointFilter(turn, sensor, Unscented(kappa=-2.0))), chain),
    }
    mean = jnp.array([0.0, 0.0, 1.0, 0.0, 0.0])
    priors = [Gaussian(mean, 0.1 * jnp.diag(jnp.array([1.0, 1.0, 1.0, 1.0, w]))) for w in (0.0, 10.0)]
    error = _squared_errors(jnp.asarray(np.broadcast_to(truth, (runs, steps, 2)), float))
    scores = {}
    for name, bank in banks.items():
        scores |= _modes_scores(name, bank, priors, (0.95, 0.05), jnp.full(steps, dt), readings, error)
    return scores


def simulate(motion: Motion, sensor: Sensor, birth: Gaussian, controls: Array, runs: int, seed: int) -> Any:
    """True states and readings, runs by steps."""

    def advance(state, inputs):
        control, key = inputs
        first, second = jax.random.split(key)
        moved = motion.sample(state, control, key=first)
        expected = sensor.expect(moved, None)
        root = jnp.linalg.cholesky(sensor.covariance(moved, None))
        return moved, (moved, expected + root @ jax.random.normal(second, expected.shape, expected.dtype))

    def one(key):
        first, second = jax.random.split(key)
        start = jax.tree.map(lambda leaf: leaf[0], birth.sample(1, key=first))
        return jax.lax.scan(advance, start, (controls, jax.random.split(second, controls.shape[0])))[1]

    return jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(seed), runs))


def _scores(
    filters: dict[str, Any], prior: Gaussian, controls: Array, readings: Any, error: Callable[[Array], Array]
) -> dict[str, Score]:
    """Errors of filters, and of their smoothers (with an s in front: "sekf")."""
    there = jnp.ones(controls.shape[0], bool)
    scores = {}
    for name, filt in filters.items():

        def paths(reading, filt=filt):
            _, history = run(filt, filt.init(prior), controls, reading, there)
            return history.states.mean, smooth(filt, history, controls).mean

        for key, path in zip((name, "s" + name), jax.jit(jax.vmap(paths))(readings), strict=True):
            scores[key] = _score(error(path))
    return scores


def _modes_scores(
    name: str,
    bank: Any,
    priors: list[Gaussian],
    shares: tuple[float, ...],
    controls: Any,
    readings: Any,
    error: Any,
    whole: bool = True,
) -> dict[str, Score]:
    states = jax.tree.map(
        lambda *leaves: jnp.stack(leaves), *[filt.init(prior) for filt, prior in zip(bank.filters, priors, strict=True)]
    )
    start = InteractingState(states, jnp.log(jnp.array(shares)), jnp.zeros((), jnp.int32))

    def paths(reading):
        _, history = run(bank, start, controls, reading, jnp.ones(controls.shape[0], bool))
        both = (history.states, smooth_interacting(bank, history, controls)) if whole else (history.states,)
        return [jax.vmap(lambda state: state.combined().mean)(states) for states in both]

    # One run after the other: a bank in a batch takes long to compile.
    found = jax.jit(lambda readings: jax.lax.map(paths, readings))(readings)
    return {key: _score(error(path)) for key, path in zip((name, "s" + name), found, strict=False)}


def _position_errors(truth: Array) -> Callable[[Array], Array]:
    return lambda path: jnp.sqrt(jnp.mean(jnp.sum((path[..., :2] - truth) ** 2, axis=-1), axis=1))


def _squared_errors(truth: Array) -> Callable[[Array], Array]:
    return lambda path: jnp.mean((path[..., :2] - truth) ** 2, axis=(1, 2))


def _score(values: Array) -> Score:
    return Score(float(jnp.mean(values)), float(jnp.std(values)) / len(values) ** 0.5)


def _discrete(model: Motion, size: int, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Transition and noise root in NumPy."""
    _, transition = model.linearize(jnp.zeros(size), jnp.array(dt))
    noise = np.asarray(model.covariance(jnp.zeros(size), jnp.array(dt)), float)
    values, vectors = np.linalg.eigh(noise)
    return np.asarray(transition, float), vectors * np.sqrt(np.maximum(values, 0.0))
