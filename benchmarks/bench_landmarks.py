"""Landmark drives: EKF-SLAM over seeds, FastSLAM beside it, and three real recordings where they lie beside us."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import linear_sum_assignment

import jaxloc as jl
from benchmarks.metric import ACCURACY, TIME, Metric, quickest
from jaxloc.data.landmarks import LandmarkLog, read_factors, read_mrclam, read_ranging
from jaxloc.data.simulate.landmarks import simulate_landmarks
from jaxloc.filters import ExtendedKalmanFilter, SigmaPointFilter, run
from jaxloc.sensors import (
    DescribedReading,
    IncrementMotion,
    RangeBearing,
    RangeBearingSensor,
    RangeSensor,
    RangingMotion,
    RangingState,
)
from jaxloc.sensors.landmarks import confusion
from jaxloc.slam.ekf_slam import EkfSlam
from jaxloc.slam.fast_slam import (
    Appearance,
    BlockProposal,
    DescriptorFastSlam,
    FastSlam,
    MeasurementProposal,
    MotionProposal,
)

_RECORDINGS = Path(__file__).resolve().parents[2] / "shared" / "data"
_MRCLAM_CLOCK = 1248272272.94  # stamp of time zero of the motion capture, from the recording's notes
_DELAYS = np.arange(0.0, 0.45, 0.05)  # s, from a command of the robot to its effect
_DEVIATIONS = (0.1, 0.03)
_GATE = 0.999
_PROPOSALS = (
    ("fast_slam_1", MotionProposal()),
    ("fast_slam_2", MeasurementProposal()),
    ("fast_slam_of_blocks", BlockProposal(200)),
)
_KINDS, _LOOKS = 5, 8  # how many landmarks look different, and numbers of a descriptor


def metrics(smoke: bool) -> Iterator[Metric]:
    with jax.enable_x64(True):
        yield from _simulated(*((2, 20) if smoke else (50, 400)))
        if not smoke and _RECORDINGS.is_dir():
            yield from _mrclam()
            yield from _plaza()
            yield from _victoria()


def _simulated(runs: int, steps: int) -> Iterator[Metric]:
    motion = IncrementMotion(drive=0.05, side=0.02, turn_drive=0.02, turn_turn=0.05)
    deviations = jnp.array(_DEVIATIONS)
    keys = jax.random.split(jax.random.key(0), runs)
    worlds = jax.jit(jax.vmap(lambda key: simulate_landmarks(motion, deviations, key=key, num_steps=steps)))(keys)
    filt = EkfSlam(motion, *_DEVIATIONS, capacity=20)
    prior = jl.beliefs.Gaussian(jl.poses.SE2(0.0, 0.0, 0.0), 1e-8 * jnp.eye(3))

    @jax.jit
    def solve(world):
        drive = (world.increments, world.readings, world.valid)
        end, history = run(filt, filt.init(prior), *drive, keep=lambda state: state.gaussian())
        nees = jax.vmap(lambda belief, pose: belief.mahalanobis_squared(pose))(history.states, world.poses)
        return nees, history.infos, _squared(end.landmarks, world.landmarks)

    nees, infos, errors = jax.block_until_ready(jax.jit(jax.vmap(solve))(worlds))
    yield Metric("landmarks.ekf_slam.nees", float(nees.mean()), "of 3", "equal", ACCURACY)
    inside = np.abs(np.asarray(nees).mean(axis=0) - 3.0) < 1.96 * np.sqrt(6.0 / runs)
    yield Metric("landmarks.ekf_slam.moments_inside_95_percent_band", float(inside.mean()), "", "higher", ACCURACY)
    yield Metric("landmarks.ekf_slam.nis", float(infos.nis[infos.dof > 0].mean()), "of 2", "equal", ACCURACY)
    one = jax.tree.map(lambda leaf: leaf[0], worlds)
    spent = quickest(lambda: solve(one), 5).wall
    yield Metric("landmarks.ekf_slam.us_a_step", 1e6 * spent / steps, "us", "lower", TIME)
    ours = float(np.sqrt(errors.mean()))
    yield Metric("landmarks.ekf_slam.landmark_rmse", ours, "m", "lower", ACCURACY)
    for name, proposal in _PROPOSALS:
        particles = FastSlam(motion, *_DEVIATIONS, num_particles=100, capacity=20, proposal=proposal)

        def follow(world, key, particles=particles):
            drive = (world.increments, world.readings, world.valid)
            end = run(particles, particles.init(prior), *drive, keep=_nothing, key=key)[0]
            return _squared(_mean_map(end), world.landmarks)

        error = float(np.sqrt(_each(follow, worlds, keys).mean()))
        yield Metric(f"landmarks.{name}.landmark_rmse_over_ekf_slam", error / ours, "x", "lower", ACCURACY)
    yield from _look_alikes(motion, prior, worlds, keys)


def _look_alikes(motion: IncrementMotion, prior: jl.beliefs.Gaussian, worlds: Any, keys: Any) -> Iterator[Metric]:
    """Numbers hidden, five kinds of looks among 20 landmarks: maps beside those with numbers."""
    slam = FastSlam(motion, *_DEVIATIONS, num_particles=100, capacity=30)
    looks = DescriptorFastSlam(slam, Appearance(0.3), length=_LOOKS)

    def numbered(world, key):
        end = run(slam, slam.init(prior), world.increments, world.readings, world.valid, keep=_nothing, key=key)[0]
        return _nearest(end, world)

    def described(world, key):
        number = world.readings.landmark
        noise = 0.1 * jax.random.normal(jax.random.fold_in(key, 1), (len(world.valid), _LOOKS))
        descriptors = jnp.eye(_KINDS, _LOOKS)[number % _KINDS] + noise
        hidden = jax.vmap(RangeBearing)(world.readings.range, world.readings.bearing, -jnp.ones_like(number))
        drive = (world.increments, jax.vmap(DescribedReading)(hidden, descriptors), world.valid)
        return _nearest(run(looks, looks.init(prior), *drive, keep=_nothing, key=key)[0].slam, world)

    hidden, rows = _each(described, worlds, keys)
    ratio = float(np.sqrt(hidden.mean() / _each(numbered, worlds, keys)[0].mean()))
    yield Metric("landmarks.fast_slam_by_looks.landmark_rmse_over_numbered", ratio, "x", "lower", ACCURACY)
    yield Metric("landmarks.fast_slam_by_looks.rows", float(rows.mean()), "of 20", "equal", ACCURACY)


def _nearest(end: Any, world: Any) -> tuple[Any, Any]:
    """Mean squared distance of the landmarks to the nearest rows of the best map, and how many rows it has."""
    known = jax.tree.map(lambda leaf: leaf[end.best()], end.maps)
    squared = jnp.sum((world.landmarks[:, None] - known.means[None]) ** 2, axis=-1)
    return jnp.mean(jnp.min(jnp.where(known.seen[None], squared, jnp.inf), axis=1)), jnp.sum(known.seen)


def _each(follow: Any, *stacked: Any) -> Any:
    """One by one, so that what is done now and then (a `BlockProposal` draws) costs nothing in between."""
    return jax.jit(lambda *items: jax.lax.map(lambda one: follow(*one), items))(*stacked)


def _mrclam() -> Iterator[Metric]:
    """Robot 1, the 300 s under motion capture."""
    motion = IncrementMotion(turn_drive=0.02, turn_turn=0.05)
    delay, log = max(((delay, _read_mrclam(delay)) for delay in _DELAYS), key=lambda pair: _evidence(pair[1], motion))
    yield Metric("landmarks.mrclam.most_likely_delay", float(delay), "s", "equal", ACCURACY)
    sensor, prior = _mrclam_model(log)
    # As the file numbers them; then as the readings that the first pass refused say they should be.
    history = _localize(ExtendedKalmanFilter(motion, sensor, gate=_GATE), prior, log)
    yield Metric("landmarks.mrclam.ekf_position_rmse_numbers_of_the_file", _rmse(history, log), "m", "lower", ACCURACY)
    costs = np.array(confusion(sensor, history.states.mean, log.readings, log.valid))
    numbers = linear_sum_assignment(costs)[1]
    moved = int(np.sum(numbers != np.arange(len(numbers))))
    yield Metric("landmarks.mrclam.numbers_corrected", moved, "landmarks", "equal", 0.0)
    corrected = log.renumbered(numbers)
    filters = {
        "ekf": ExtendedKalmanFilter(motion, sensor, gate=_GATE),
        "ukf": SigmaPointFilter(motion, sensor, gate=_GATE),
        "ekf_without_gate": ExtendedKalmanFilter(motion, sensor),
    }
    for name, filt in filters.items():
        history = _localize(filt, prior, corrected)
        yield Metric(f"landmarks.mrclam.{name}_position_rmse", _rmse(history, log), "m", "lower", ACCURACY)
    yield Metric("landmarks.mrclam.nees_median", float(np.median(_nees(history, log))), "of 3", "lower", ACCURACY)
    yield from _mrclam_slam(corrected, motion)


def _read_mrclam(delay: float) -> LandmarkLog:
    log = read_mrclam(_RECORDINGS / "mrclam1_robot1", 1, truth_start=_MRCLAM_CLOCK, delay=float(delay))
    return log.first(int(log.truth_valid.sum()))


def _mrclam_model(log: LandmarkLog) -> tuple[RangeBearingSensor, jl.beliefs.Gaussian]:
    return RangeBearingSensor(log.landmarks, 0.12, 0.04), jl.beliefs.Gaussian(_first(log.truth), 0.01 * jnp.eye(3))


def _evidence(log: LandmarkLog, motion: IncrementMotion) -> float:
    """Log-likelihood of the readings; one that is refused counts zero, as of clutter of one a metre and radian."""
    sensor, prior = _mrclam_model(log)
    history = _localize(ExtendedKalmanFilter(motion, sensor, gate=_GATE), prior, log)
    return float(history.infos.log_likelihood.sum())


def _mrclam_slam(log: LandmarkLog, motion: IncrementMotion) -> Iterator[Metric]:
    prior = jl.beliefs.Gaussian(_first(log.truth), 1e-6 * jnp.eye(3))
    drive = (log.increments, log.readings, log.valid)
    seen_well = np.bincount(np.asarray(log.readings.landmark), minlength=len(log.names)) >= 10
    filt = EkfSlam(motion, *_DEVIATIONS, capacity=len(log.names))
    end = run(filt, filt.init(prior), *drive, keep=_nothing)[0]
    ekf = _map_errors(end.landmarks, log.landmarks, seen_well)
    yield Metric("landmarks.mrclam.ekf_slam_landmark_rmse", ekf[0], "m", "lower", ACCURACY)
    yield Metric("landmarks.mrclam.ekf_slam_landmark_rmse_aligned", ekf[1], "m", "lower", ACCURACY)
    for name, proposal in _PROPOSALS:
        particles = FastSlam(motion, *_DEVIATIONS, num_particles=100, capacity=len(log.names), proposal=proposal)

        def follow(key, particles=particles):
            return _mean_map(run(particles, particles.init(prior), *drive, keep=_nothing, key=key)[0])

        maps = _each(follow, jax.random.split(jax.random.key(0), 20))
        errors = np.array([_map_errors(points, log.landmarks, seen_well) for points in maps])
        median = np.median(errors, axis=0)
        yield Metric(f"landmarks.mrclam.{name}_landmark_rmse", median[0], "m", "lower", ACCURACY)
        yield Metric(f"landmarks.mrclam.{name}_aligned_over_ekf_slam", median[1] / ekf[1], "x", "lower", ACCURACY)


def _plaza() -> Iterator[Metric]:
    """Plaza 1, with nothing, a bias, a scale, or both in the state beside the pose."""
    log = read_ranging(_RECORDINGS / "range_slam_plaza1", "Plaza1")
    motion = IncrementMotion(turn_drive=0.002, turn_turn=0.02, turn_idle=0.0005, idle=0.003)
    sensor = RangeSensor(log.landmarks, 0.5)
    pose, variances = _first(log.truth), jnp.array([1.0, 1.0, 0.01])
    filt = ExtendedKalmanFilter(motion, sensor)
    history = _localize(filt, jl.beliefs.Gaussian(pose, jnp.diag(variances)), log)
    yield from _ranging_metrics("pose_alone", history, log)
    zero = jnp.zeros(())
    for name, bias, scale in (("bias", 1.0, 0.0), ("scale", 0.0, 1.0), ("bias_and_scale", 1.0, 1.0)):
        wandering = RangingMotion(motion, 0.01 * bias + 1e-9, 5e-4 * scale + 1e-9)
        spread = jnp.concatenate([variances, jnp.array([9.0 * bias + 1e-12, 0.01 * scale + 1e-12])])
        prior = jl.beliefs.Gaussian(RangingState(pose, zero, zero), jnp.diag(spread))
        yield from _ranging_metrics(name, _localize(ExtendedKalmanFilter(wandering, sensor), prior, log), log)


def _ranging_metrics(name: str, history: Any, log: LandmarkLog) -> Iterator[Metric]:
    yield Metric(f"landmarks.plaza1.{name}.position_rmse", _rmse(history, log), "m", "lower", ACCURACY)
    yield Metric(f"landmarks.plaza1.{name}.nis", float(history.infos.nis.mean()), "of 1", "equal", ACCURACY)
    yield Metric(f"landmarks.plaza1.{name}.nees_median", float(np.median(_nees(history, log))), "of 3", "lower", 0.2)


def _victoria() -> Iterator[Metric]:
    """Victoria Park: 151 trees, no truth; what is measured is time and how well readings fit."""
    log = read_factors(_RECORDINGS / "victoria_park" / "victoria_park.txt")
    motion = IncrementMotion(drive=0.14, side=0.07, idle=0.01, turn_drive=0.1, turn_turn=0.05, turn_idle=0.002)
    filt = EkfSlam(motion, 0.6, 0.06, capacity=len(log.names))
    state = filt.init(jl.beliefs.Gaussian(jl.poses.SE2(0.0, 0.0, 0.0), 1e-6 * jnp.eye(3)))

    def solve():
        return run(filt, state, log.increments, log.readings, log.valid, keep=_nothing)

    spent = quickest(solve, 2).wall
    yield Metric("landmarks.victoria_park.us_a_reading", 1e6 * spent / len(log), "us", "lower", TIME)
    accepted = float(solve()[1].infos.accepted.mean())
    yield Metric("landmarks.victoria_park.accepted", accepted, "", "higher", ACCURACY)


def _nothing(state: Any) -> None:
    del state


def _localize(filt: Any, prior: Any, log: LandmarkLog) -> Any:
    drive = (log.increments, log.readings, log.valid)
    return run(filt, filt.init(prior), *drive, keep=lambda state: state.gaussian())[1]


def _first(poses: Any) -> Any:
    return jax.tree.map(lambda leaf: leaf[0], poses)


def _pose(mean: Any) -> Any:
    return mean.pose if isinstance(mean, RangingState) else mean


def _rmse(history: Any, log: LandmarkLog) -> float:
    gaps = np.asarray(_pose(history.states.mean).translation - log.truth.translation)
    return float(np.sqrt(np.mean(np.sum(gaps[np.asarray(log.truth_valid)] ** 2, axis=1))))


def _nees(history: Any, log: LandmarkLog) -> np.ndarray:
    def one(mean, covariance, truth):
        return jl.beliefs.Gaussian(_pose(mean), covariance[:3, :3]).mahalanobis_squared(truth)

    return np.asarray(jax.vmap(one)(history.states.mean, history.states.covariance, log.truth))


def _squared(points: Any, truth: Any) -> Any:
    return jnp.mean(jnp.sum((points - truth) ** 2, axis=1))


def _mean_map(end: Any) -> Any:
    return jnp.sum(jnp.exp(end.log_weights)[:, None, None] * end.maps.means, axis=0)


def _map_errors(points: Any, truth: Any, rows: np.ndarray) -> tuple[float, float]:
    """Root mean square errors of a map: as it lies, and moved rigidly onto the truth."""
    points, truth = np.asarray(points)[rows], np.asarray(truth)[rows]
    a, b = points - points.mean(axis=0), truth - truth.mean(axis=0)
    angle = np.arctan2(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), np.sum(a * b))
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    lying, aligned = points - truth, a @ turn.T - b
    return tuple(float(np.sqrt(np.mean(np.sum(gap**2, axis=1)))) for gap in (lying, aligned))
