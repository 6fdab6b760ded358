"""Filters: the published tables of the EKF/UKF toolbox, float32 with a vague prior, speed beside filterpy."""

from collections.abc import Iterator
from typing import Any

import filterpy.kalman
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import toolbox
from benchmarks.metric import ACCURACY, TIME, Metric, Timing, compiled, in_fresh_process, quickest, versus
from jaxloc.beliefs import Gaussian
from jaxloc.filters import (
    ConstantVelocity,
    Cubature,
    KalmanFilter,
    LinearMotion,
    LinearSensor,
    SigmaPointFilter,
    run,
    run_parallel,
    smooth,
    smooth_parallel,
)

_DT = 0.1


def metrics(smoke: bool) -> Iterator[Metric]:
    yield from _tables(smoke)
    yield from _stiff(200 if smoke else 1000)
    yield from _speed(50 if smoke else 2000, 10 if smoke else 1000, 1 if smoke else 5)


def _tables(smoke: bool) -> Iterator[Metric]:
    runs = 2 if smoke else 400
    for name, scores in (
        ("ungm", toolbox.ungm(runs, 20 if smoke else 500)),
        ("bearings", toolbox.bearings(runs)),
        ("maneuvers", toolbox.maneuvers(2 * runs)),
        ("turns", toolbox.turns(runs)),
    ):
        unit = "m" if name == "bearings" else "m^2"
        for key, score in scores.items():
            yield Metric(f"filters.{name}.{key}", score.mean, unit, "lower", ACCURACY)
    if not smoke:
        found = in_fresh_process("benchmarks.toolbox", "reentry_means", "100", environment={"JAX_ENABLE_X64": "true"})
        for key, mean in found.items():
            yield Metric(f"filters.reentry.{key}", mean, "km", "lower", ACCURACY)


def stiff_roots(dtype: str, steps: str) -> list:
    """Covariance roots of a filter whose prior has ``1e10`` times the variance of its sensor."""
    kind = jnp.dtype(dtype)
    sensor = LinearSensor(jnp.eye(2, 4, dtype=kind), 1e-4 * jnp.eye(2, dtype=kind))
    filt = KalmanFilter(ConstantVelocity(jnp.asarray(0.01, kind)), sensor)
    start = filt.init(Gaussian(jnp.zeros(4, kind), 1e6 * jnp.eye(4, dtype=kind)))
    readings = jnp.zeros((int(steps), 2), kind)
    _, history = run(filt, start, jnp.ones(int(steps), kind), readings, jnp.ones(int(steps), bool))
    return np.asarray(history.states.covariance_sqrt, float).tolist()


def _stiff(steps: int) -> Iterator[Metric]:
    exact = np.array(
        in_fresh_process(__name__, "stiff_roots", "float64", str(steps), environment={"JAX_ENABLE_X64": "true"})
    )
    found = np.array(stiff_roots("float32", str(steps)))
    exact, found = (roots @ roots.transpose(0, 2, 1) for roots in (exact, found))
    error = np.linalg.norm(found - exact, axis=(1, 2)) / np.linalg.norm(exact, axis=(1, 2))
    yield Metric("filters.stiff.covariance_error", float(error.max()), "relative", "lower", 4.0)
    bad = np.linalg.eigvalsh(np.nan_to_num(found)).min(axis=1) <= 0.0
    yield Metric("filters.stiff.bad_steps", float(bad.sum()), "steps", "lower", 0.0)


def _models() -> tuple[LinearMotion, LinearSensor, Gaussian]:
    model = ConstantVelocity(0.1)
    _, transition = model.linearize(jnp.zeros(4), jnp.array(_DT))
    motion = LinearMotion(transition, model.covariance(jnp.zeros(4), jnp.array(_DT)))
    return motion, LinearSensor(jnp.eye(2, 4), 0.1 * jnp.eye(2)), Gaussian(jnp.zeros(4), jnp.eye(4))


def _speed(steps: int, batch: int, repeats: int) -> Iterator[Metric]:
    motion, sensor, prior = _models()
    readings = np.random.default_rng(0).normal(size=(steps, 2)).astype(np.float32)
    given, there = jnp.asarray(readings), jnp.ones(steps, bool)
    filters = {"kf": KalmanFilter(motion, sensor), "ukf": SigmaPointFilter(motion, sensor, Cubature())}
    for name, filt in filters.items():
        program, took = compiled(run, filt, filt.init(prior), None, given, there)
        ours = quickest(lambda: program(filt, filt.init(prior), None, given, there), repeats)  # noqa: B023
        yield Metric(f"filters.{name}.step", 1e6 * ours.wall / steps, "us", "lower", TIME)
        yield Metric(f"filters.{name}.compile", took.cpu, "CPU s", "lower", TIME)
        count = min(steps, 200)
        peer = quickest(lambda: _peer(name, readings[:count]), min(repeats, 2))  # noqa: B023
        scale = steps / count
        yield from versus(f"filters.{name}.filterpy", ours, Timing(peer.wall * scale, peer.cpu * scale))
    yield from _batch(filters["kf"], prior, batch, repeats)
    yield from _parallel(filters["kf"], prior, given, there, repeats)


def _batch(filt: KalmanFilter, prior: Gaussian, batch: int, repeats: int, steps: int = 100) -> Iterator[Metric]:
    """Many filters at once, each with its own prior, masks and readings."""
    rng = np.random.default_rng(1)
    readings = jnp.asarray(rng.normal(size=(batch, steps, 2)), jnp.float32)
    valid = jnp.asarray(rng.uniform(size=(batch, steps)) < 0.9)
    scales = jnp.asarray(rng.uniform(1.0, 2.0, size=batch), jnp.float32)

    def one(scale, readings, valid):
        start = filt.init(Gaussian(prior.mean, scale * prior.covariance))
        last, history = run(filt, start, None, readings, valid, keep=lambda state: state.mean)
        return last, history.states, history.infos.log_likelihood

    program, _ = compiled(jax.vmap(one), scales, readings, valid)
    took = quickest(lambda: program(scales, readings, valid), repeats)
    yield Metric("filters.kf.batch_step", 1e6 * took.wall / (batch * steps), "us", "lower", TIME)


def _parallel(filt: KalmanFilter, prior: Gaussian, readings: Any, there: Any, repeats: int) -> Iterator[Metric]:
    """Parallel in time beside one step after the other."""
    start = filt.init(prior)
    history = run(filt, start, None, readings, there)[1]
    pairs = {
        "run": (
            lambda r: run(filt, start, None, r, there)[1].states.mean,
            lambda r: run_parallel(filt, start, None, r, there)[1].states.mean,
            readings,
        ),
        "smooth": (lambda h: smooth(filt, h, None).mean, lambda h: smooth_parallel(filt, h, None).mean, history),
    }
    for name, (one, other, data) in pairs.items():
        first, second = compiled(one, data)[0], compiled(other, data)[0]
        took = [quickest(lambda: program(data), repeats) for program in (second, first)]  # noqa: B023
        yield from versus(f"filters.parallel.{name}", *took)
        gap = float(jnp.abs(first(data) - second(data)).max())
        yield Metric(f"filters.parallel.{name}.gap", gap, "m", "lower", 4.0)


def _peer(name: str, readings: np.ndarray) -> np.ndarray:
    """The same filter of filterpy."""
    motion, sensor, prior = _models()
    transition, noise, spread = (
        np.asarray(a, float) for a in (motion.transition, motion.noise_covariance, sensor.noise_covariance)
    )
    if name == "kf":
        peer = filterpy.kalman.KalmanFilter(4, 2)
        peer.F, peer.H, peer.x = transition, np.eye(2, 4), np.zeros((4, 1))
    else:
        points = filterpy.kalman.MerweScaledSigmaPoints(4, 1.0, 0.0, 0.0)
        peer = filterpy.kalman.UnscentedKalmanFilter(4, 2, _DT, lambda x: x[:2], lambda x, dt: transition @ x, points)
    peer.Q, peer.R, peer.P = noise, spread, np.asarray(prior.covariance, float)
    for reading in readings:
        peer.predict()
        peer.update(reading)
    return peer.x
