"""Localization in a map: steps a second beside a NumPy filter, and how near it comes on a real building."""

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scipy import ndimage

import jaxloc as jl
from benchmarks.metric import ACCURACY, REPOSITORY, TIME, Metric, quickest, timed, versus
from jaxloc.filters import MonteCarloLocalization, Recovery
from jaxloc.poses import SE2
from jaxloc.poses.planar import relative_poses
from jaxloc.sensors import BeamModel, DistanceField, LaserScan, LikelihoodField, OccupancyMap, OdometryMotion

_BUILDING = REPOSITORY.parent / "shared" / "data" / "mcl_fr079"
_BEAMS, _SIGMA, _Z_HIT, _MAX_RANGE, _WORTH = 60, 0.1, 0.9, 30.0, 15.0
_GLOBAL = 20_000


def metrics(smoke: bool) -> Iterator[Metric]:
    drive = jl.data.simulate_laser_drive(seed=3)
    grid = drive.building.map()
    yield from _field(grid)
    for count in (2000, _GLOBAL):
        yield from _step(drive, grid, count)
    yield from _rays(drive, grid)
    if _BUILDING.is_dir():
        yield from _building(_BUILDING, num_seeds=1 if smoke else 20, num_tracked=1 if smoke else 5)


def make_filter(grid: OccupancyMap, mount: SE2) -> MonteCarloLocalization:
    """The filter that is measured."""
    field = DistanceField.of(grid, ceiling=0.6, surfaces=True)
    sensor = LikelihoodField(field, mount, sigma=_SIGMA, z_hit=_Z_HIT, max_range=_MAX_RANGE, independent_beams=_WORTH)
    motion = OdometryMotion(drive_turn=0.1, turn_floor=0.02, drive_floor=0.02, slip=0.1)
    return MonteCarloLocalization(motion, sensor, grid.free_space(), recovery=Recovery(readings=_WORTH))


def _field(grid: OccupancyMap) -> Iterator[Metric]:
    ours = quickest(lambda: DistanceField.of(grid, ceiling=20.0).distance)
    occupied = np.asarray(grid.occupied)
    peer = quickest(lambda: ndimage.distance_transform_edt(~occupied))
    yield Metric("localization.field", 1e3 * ours.wall, "ms", "lower", TIME)
    yield from versus("localization.field.vs_scipy", ours, peer)


def _step(drive: jl.data.LaserDrive, grid: OccupancyMap, count: int) -> Iterator[Metric]:
    """A whole step: resample, move, weigh by 60 beams, estimate; while tracking, and in a cloud over the whole map."""
    filt = make_filter(grid, drive.log.mount_pose())
    scans = drive.log.scans().thin(_BEAMS)
    motions = _stack(relative_poses(drive.log.odometry[:40], drive.log.odometry[1:41]))
    chosen = jax.tree.map(lambda leaf: leaf[1:41], scans)
    valid = jnp.ones(chosen.ranges.shape, bool)
    truth = SE2(*(float(value) for value in drive.truth[0]))
    near = filt.init_near(jl.beliefs.Gaussian(truth, 0.01 * jnp.eye(3)), count, key=jax.random.key(0))
    anywhere = filt.init_globally(count, key=jax.random.key(0))

    def run(state):
        return jl.filters.run(filt, state, motions, chosen, valid, keep=_steps_only, key=jax.random.key(1))[1].infos.ess

    ours = quickest(partial(run, near), 3)
    scattered = quickest(partial(run, anywhere), 3)
    peer_filter = NumpyFilter(grid, np.asarray(drive.log.mount), count)
    readings = np.asarray(chosen.ranges), np.asarray(chosen.angles[0] if chosen.angles.ndim > 1 else chosen.angles)
    controls = relative_poses(drive.log.odometry[:40], drive.log.odometry[1:41])
    peer = quickest(lambda: peer_filter.run(drive.truth[0], controls, *readings), 2)
    yield Metric(f"localization.step_{count}.rate", 40 / ours.wall, "Hz", "higher", TIME)
    yield Metric(f"localization.step_{count}.global.rate", 40 / scattered.wall, "Hz", "higher", TIME)
    yield Metric(f"localization.step_{count}.numpy.rate", 40 / peer.wall, "Hz", "higher")
    yield from versus(f"localization.step_{count}.vs_numpy", ours, peer)


def _rays(drive: jl.data.LaserDrive, grid: OccupancyMap) -> Iterator[Metric]:
    """The beam model: 2000 poses, 60 rays each."""
    sensor = BeamModel(DistanceField.of(grid, ceiling=5.0), max_range=20.0)
    poses = grid.free_space().sample_evenly(2000, key=jax.random.key(0))
    scan = LaserScan(jnp.asarray(drive.log.ranges[0]), drive.log.angle_min, drive.log.angle_increment).thin(_BEAMS)
    weigh = jax.jit(jax.vmap(lambda pose: sensor.log_prob(pose, scan, jnp.array(True))))
    yield Metric("localization.beam_model_2000", 1e3 * quickest(lambda: weigh(poses)).wall, "ms", "lower", TIME)


def _building(folder: Path, num_seeds: int, num_tracked: int) -> Iterator[Metric]:
    """Freiburg, building 079: the map was made of the even keyframes, the odd ones are tracked by raw odometry."""
    log = jl.data.carmen.read_log(folder / "fr079_corrected.log.gz")
    keyframes = np.load(folder / "keyframes.npz")
    grid = jl.data.ros_map.read_map(folder / "map_from_even_scans.yaml")
    truth, odometry = keyframes["ref"][1::2], keyframes["odom"][1::2]
    scans = log.scans(slice(1, None, 2)).thin(_BEAMS)
    motions = _stack(np.concatenate([np.zeros((1, 3)), relative_poses(odometry[:-1], odometry[1:])]))
    filt = make_filter(grid, log.mount_pose())

    def run(state, steps, key):
        control, chosen = (jax.tree.map(lambda leaf: leaf[steps], tree) for tree in (motions, scans))
        valid = jnp.ones(chosen.ranges.shape, bool)
        _, history = jl.filters.run(filt, state, control, chosen, valid, keep=_steps_only, key=key)
        mean = history.infos.place.pose.mean
        poses = np.column_stack([mean.translation, np.arctan2(mean.rotation.sin, mean.rotation.cos)])
        errors = relative_poses(poses.astype(np.float64), truth[steps])
        return np.hypot(errors[:, 0], errors[:, 1]), np.degrees(np.abs(errors[:, 2]))

    start = jl.beliefs.Gaussian(SE2(*(float(v) for v in truth[0])), jnp.diag(jnp.array([0.04, 0.04, 0.01])))
    everything = slice(0, len(truth))
    runs = [
        run(filt.init_near(start, 2000, key=jax.random.key(seed)), everything, jax.random.key(seed + 100))
        for seed in range(num_tracked)
    ]
    position, heading = (np.concatenate([found[part] for found in runs]) for part in (0, 1))
    yield Metric("localization.fr079.position", float(np.median(position)), "m", "lower", ACCURACY)
    yield Metric("localization.fr079.position_95", float(np.percentile(position, 95)), "m", "lower", 2 * ACCURACY)
    yield Metric("localization.fr079.heading", float(np.median(heading)), "deg", "lower", ACCURACY)
    peer = NumpyFilter(grid, np.asarray(log.mount), 2000)
    controls = np.concatenate([np.zeros((1, 3)), relative_poses(odometry[:-1], odometry[1:])])
    poses, took = timed(lambda: peer.run(truth[0], controls, np.asarray(scans.ranges), np.asarray(scans.angles)))
    error = np.hypot(*(poses[:, :2] - truth[:, :2]).T)
    yield Metric("localization.fr079.position.numpy", float(np.median(error)), "m")
    yield Metric("localization.fr079.position_95.numpy", float(np.percentile(error, 95)), "m")
    yield from _global_starts(filt, run, len(truth), num_seeds)


def _global_starts(filt: MonteCarloLocalization, run, count: int, num_seeds: int) -> Iterator[Metric]:
    """From anywhere, at the first keyframe and, with other seeds, along the way."""
    for name, starts in (("", [0] * num_seeds), (".anywhere", np.linspace(0, count - 101, num_seeds).astype(int))):
        ends, needed = [], []
        for seed, first in enumerate(starts):
            state = filt.init_globally(_GLOBAL, key=jax.random.key(seed))
            error, _ = run(state, slice(int(first), int(first) + 100), jax.random.key(seed + 200))
            wrong = np.flatnonzero(error > 1.0)
            ends.append(np.median(error[-10:]) < 0.25)
            needed.append(int(wrong[-1]) + 2 if wrong.size else 1)
        yield Metric(f"localization.fr079.global{name}.found", float(np.mean(ends)), "of 1", "higher", 0.051)
        yield Metric(f"localization.fr079.global{name}.keyframes", float(np.median(needed)), "keyframes", "lower")
        yield Metric(f"localization.fr079.global{name}.keyframes_most", float(np.max(needed)), "keyframes", "lower")


class NumpyFilter:
    """The plain filter that many write first: likelihood field, Thrun's odometry noise, resampling by the sample size.

    Args:
        grid: the map.
        mount: (x, y, heading) of the laser.
        count: number of particles.
    """

    def __init__(self, grid: OccupancyMap, mount: np.ndarray, count: int):
        self.resolution = float(grid.resolution)
        self.origin = np.array([float(grid.origin.x), float(grid.origin.y)])
        distance = ndimage.distance_transform_edt(~np.asarray(grid.occupied)) * self.resolution
        hit = _Z_HIT / (_SIGMA * np.sqrt(2 * np.pi)) * np.exp(-0.5 * (distance / _SIGMA) ** 2)
        self.table = np.log(hit + (1 - _Z_HIT) / _MAX_RANGE).astype(np.float32)
        self.mount, self.count = mount, count

    def run(self, start: np.ndarray, controls: np.ndarray, ranges: np.ndarray, angles: np.ndarray) -> np.ndarray:
        """Mean poses."""
        rng = np.random.default_rng(0)
        particles = start + rng.standard_normal((self.count, 3)) * [0.2, 0.2, 0.1]
        log_weights, means = np.zeros(self.count), []
        for control, reading in zip(controls, ranges, strict=True):
            particles = self._move(particles, control, rng)
            log_weights = log_weights + self._weigh(particles, reading, angles)
            weights = np.exp(log_weights - log_weights.max())
            weights /= weights.sum()
            heading = np.arctan2(weights @ np.sin(particles[:, 2]), weights @ np.cos(particles[:, 2]))
            means.append([*(weights @ particles[:, :2]), heading])
            log_weights = np.log(np.maximum(weights, 1e-300))
            if 1.0 / np.sum(weights**2) < 0.5 * self.count:
                points = (np.arange(self.count) + rng.uniform()) / self.count
                ancestors = np.minimum(np.searchsorted(np.cumsum(weights), points), self.count - 1)
                particles, log_weights = particles[ancestors], np.full(self.count, -np.log(self.count))
        return np.array(means)

    def _move(self, particles: np.ndarray, control: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        way = np.hypot(control[0], control[1])
        first = np.arctan2(control[1], control[0]) if way > 0.01 else 0.0
        first = (first + np.pi / 2) % np.pi - np.pi / 2
        way = way * np.sign(control[0] or 1.0)
        second = control[2] - first
        noise = rng.standard_normal((3, self.count))
        turn = np.sqrt((0.1 * way) ** 2 + 0.02**2)
        along = np.sqrt((0.1 * way) ** 2 + 0.01 * (first**2 + second**2) + 0.02**2)
        heading = particles[:, 2] + first + noise[0] * np.hypot(turn, 0.1 * first)
        length = way + noise[1] * along
        x = particles[:, 0] + length * np.cos(heading)
        y = particles[:, 1] + length * np.sin(heading)
        return np.stack([x, y, heading + second + noise[2] * np.hypot(turn, 0.1 * second)], axis=1)

    def _weigh(self, particles: np.ndarray, reading: np.ndarray, angles: np.ndarray) -> np.ndarray:
        use = np.isfinite(reading) & (reading < _MAX_RANGE)
        x = self.mount[0] + reading[use] * np.cos(angles[use] + self.mount[2])
        y = self.mount[1] + reading[use] * np.sin(angles[use] + self.mount[2])
        cos, sin = np.cos(particles[:, 2:]), np.sin(particles[:, 2:])
        columns = (particles[:, :1] + cos * x - sin * y - self.origin[0]) / self.resolution
        rows = (particles[:, 1:2] + sin * x + cos * y - self.origin[1]) / self.resolution
        columns = np.clip(columns.astype(np.int32), 0, self.table.shape[1] - 1)
        rows = np.clip(rows.astype(np.int32), 0, self.table.shape[0] - 1)
        return self.table[rows, columns].sum(axis=1) * min(_WORTH / max(use.sum(), 1), 1.0)


def _steps_only(state):
    """Keeps no clouds; one function, for a new one each time would compile anew."""
    return state.step


def _stack(poses: np.ndarray) -> SE2:
    return jax.vmap(SE2)(*jnp.asarray(poses, jnp.float32).T)
