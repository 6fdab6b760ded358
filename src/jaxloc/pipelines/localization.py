"""Localization of a laser log in an occupancy map: from anywhere or from a known start.

Host code that drives `MonteCarloLocalization` in chunks of scans: many particles until the robot is found, few while
its place is known, many again when scans stop fitting.
"""

from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float64, Int, Key

from jaxloc.beliefs import Gaussian
from jaxloc.beliefs.particles import finite_log_weights
from jaxloc.beliefs.resampling.indices import systematic
from jaxloc.filters import MonteCarloLocalization, Recovery, run
from jaxloc.filters.localization import LocalizationState
from jaxloc.poses import SE2
from jaxloc.poses.planar import compose_poses, relative_poses
from jaxloc.sensors import DistanceField, LaserScan, LikelihoodField, OccupancyMap, OdometryMotion

_CLOUD = 600  # particles of a step that are kept for images
_STREAK = 3  # scans in a row that must agree before the robot counts as found


class Odometry(eqx.Module):
    """How the odometry errs; see `OdometryMotion`.

    Attributes:
        turn_turn: rad for a rad of turn.
        turn_drive: rad for a meter.
        drive_drive: m for a meter.
        drive_turn: m for a rad.
        turn_floor: rad a step.
        drive_floor: m a step.
        slip: probability that a step's distance is not to be trusted.
        slip_scale: how far it is off then, as a part of it.
    """

    turn_turn: float = 0.1
    turn_drive: float = 0.1
    drive_drive: float = 0.1
    drive_turn: float = 0.1
    turn_floor: float = 0.02
    drive_floor: float = 0.02
    slip: float = 0.1
    slip_scale: float = 1.5


class Config(eqx.Module):
    """Options of localization.

    Attributes:
        num_particles: while the place is known.
        num_particles_global: while it is not.
        num_beams: of a scan that are used.
        sigma: of the end points of beams about the walls, m.
        z_hit: part of the beams that end at walls of the map.
        independent_beams: how many beams a scan is worth.
        max_range: longer beams count nothing, m.
        odometry: how it errs.
        min_translation: a scan is used when the robot has moved so far since the last one, m,
        min_rotation: or turned so far, rad.
        least_ess: part of the particles that a scan leaves at least.
        start_translation: standard deviation of a given start, m.
        start_rotation: the same, rad.
        found_mass: the place is known when one cluster holds so much of the weight,
        found_spread: and its standard deviation is no greater, m.
        lost_share: many particles again when so great a part is to be replaced by random ones.
        chunk: scans between two looks at that.
        seed: of the random numbers.
    """

    num_particles: int = 2000
    num_particles_global: int = 20_000
    num_beams: int = 60
    sigma: float = 0.08
    z_hit: float = 0.9
    independent_beams: float = 20.0
    max_range: float = 30.0
    odometry: Odometry = Odometry()
    min_translation: float = 0.1
    min_rotation: float = 0.1
    least_ess: float = 0.01
    start_translation: float = 0.3
    start_rotation: float = 0.2
    found_mass: float = 0.95
    found_spread: float = 0.3
    lost_share: float = 0.15
    chunk: int = 10
    seed: int = 0

    def __check_init__(self):
        for name in ("num_particles", "num_particles_global", "num_beams", "chunk"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}, must be at least 1")
        for name in ("sigma", "max_range", "independent_beams"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} is {getattr(self, name)}, must be positive")
        if not 0 < self.z_hit < 1:
            raise ValueError(f"z_hit is {self.z_hit}, must lie between 0 and 1")


class Step(eqx.Module):
    """Where the robot was at one scan.

    Attributes:
        index: number of the scan in the log.
        time: stamp, s.
        pose: (x, y, heading) of the robot in the map, m and rad.
        covariance: of the pose, right tangent (x and y of the robot, heading); that of the last scan that was used.
        mass: part of the weight in the cluster that the pose is the mean of.
        updated: whether this scan was used; where not, odometry carried the pose on from the last one.
        ess: effective sample size.
        inject: part of the cloud that scans asked to be replaced.
        num_particles: of the cloud.
        found: whether the place is known, and was at the scans used before.
        cloud: "m 3" some of the particles, drawn by weight; none where the scan was not used.
    """

    index: int
    time: float
    pose: Float64[np.ndarray, "3"]
    covariance: Float64[np.ndarray, "3 3"]
    mass: float
    updated: bool
    ess: float
    inject: float
    num_particles: int
    found: bool
    cloud: np.ndarray


def steps(log: Any, grid: OccupancyMap, start: SE2 | None = None, config: Config | None = None) -> Iterator[Step]:
    """Localizes a robot, a step a scan.

    Args:
        log: a `LaserLog`, or any record with its fields.
        grid: the map.
        start: pose at the first scan; anywhere in the free space where not given.
        config: options.

    Yields:
        A step for each scan, the first included.

    Raises:
        ValueError: the map has no obstacle or no free cell.

    References:
        Thrun, Burgard, Fox, *Probabilistic Robotics*, 2005, chapter 8 [R-11].
    """
    config = Config() if config is None else config
    filt = make_filter(log, grid, config)
    key_start, key_run = jax.random.split(jax.random.key(config.seed))
    if start is None:
        state = filt.init_globally(config.num_particles_global, key=key_start)
    else:
        sigmas = jnp.array([config.start_translation, config.start_translation, config.start_rotation])
        state = filt.init_near(Gaussian(start, jnp.diag(sigmas**2)), config.num_particles, key=key_start)
    used = select_scans(log.odometry, config.min_translation, config.min_rotation)
    done, streak, last = 0, 0, None
    for chunk in np.split(used, range(config.chunk, len(used), config.chunk)):
        state, kept = _advance(filt, state, log, used, chunk, config, key_run)
        for place in range(len(chunk)):
            for index in range(done, chunk[place]):
                yield _carried(last, log, index)
            streak = streak + 1 if _is_sure(kept, place, config) else 0
            last = _step(kept, place, int(chunk[place]), log, streak >= _STREAK, state.particles.size)
            done = int(chunk[place]) + 1
            yield last
        state = _resize(filt, state, last, config)
    for index in range(done, len(log.times)):
        yield _carried(last, log, index)


def make_filter(log: Any, grid: OccupancyMap, config: Config) -> MonteCarloLocalization:
    """The filter for a log in a map.

    Args:
        log: for the mount of its laser.
        grid: the map.
        config: options.

    Returns:
        The filter.

    Raises:
        ValueError: the map has no obstacle or no free cell.
    """
    if not bool(jnp.any(grid.occupied)):
        raise ValueError("The map has no obstacle: nothing to localize by.")
    options = config.odometry
    names = [name for name in vars(Odometry()) if not name.startswith("_")]
    motion = OdometryMotion(**{name: getattr(options, name) for name in names})
    field = DistanceField.of(grid, ceiling=max(6.0 * config.sigma, 0.5), surfaces=True)
    sensor = LikelihoodField(
        field,
        SE2(*log.mount),
        sigma=config.sigma,
        z_hit=config.z_hit,
        max_range=config.max_range,
        independent_beams=config.independent_beams,
    )
    recovery = Recovery(readings=min(config.independent_beams, float(config.num_beams)))
    return MonteCarloLocalization(motion, sensor, grid.free_space(), least_ess=config.least_ess, recovery=recovery)


def select_scans(
    odometry: Float64[np.ndarray, "n 3"], min_translation: float, min_rotation: float
) -> Int[np.ndarray, " k"]:
    """Scans that are worth using: the first, and each at which the robot has moved enough since the last.

    Args:
        odometry: poses (x, y, heading) at the scans, m and rad.
        min_translation: m.
        min_rotation: rad.

    Returns:
        Their indices.

    Example:
        >>> select_scans(np.array([[0.0, 0, 0], [0.1, 0, 0], [0.2, 0, 0], [0.2, 0, 0.5]]), 0.15, 0.3).tolist()
        [0, 2, 3]
    """
    chosen = [0]
    for index in range(1, len(odometry)):
        way = odometry[index] - odometry[chosen[-1]]
        turn = abs((way[2] + np.pi) % (2.0 * np.pi) - np.pi)
        if np.hypot(way[0], way[1]) >= min_translation or turn >= min_rotation:
            chosen.append(index)
    return np.array(chosen)


class _Kept(eqx.Module):
    """What an image and a table need of a state."""

    cloud: Float[Array, "m 3"]


def _keep(state: LocalizationState) -> _Kept:
    particles = state.particles
    drawn = particles.take(systematic(jax.random.key(0), finite_log_weights(particles), _CLOUD))
    heading = jnp.arctan2(drawn.rotation.sin, drawn.rotation.cos)
    return _Kept(jnp.concatenate([drawn.translation, heading[:, None]], axis=1))


def _advance(
    filt: MonteCarloLocalization,
    state: LocalizationState,
    log: Any,
    used: np.ndarray,
    chunk: np.ndarray,
    config: Config,
    key: Key[Array, ""],
) -> tuple[LocalizationState, Any]:
    """The filter over one chunk, padded to a fixed number of scans so that one program serves all."""
    size = config.chunk
    padded = np.concatenate([chunk, np.full(size - len(chunk), chunk[-1])])
    place = np.searchsorted(used, padded)
    before = used[np.maximum(place - 1, 0)]
    motions = relative_poses(log.odometry[before], log.odometry[padded]).astype(np.float32)
    controls = jax.vmap(SE2)(*jnp.asarray(motions).T)
    scans = LaserScan(jnp.asarray(log.ranges[padded]), log.angle_min, log.angle_increment).thin(config.num_beams)
    valid = _below_limit(scans.ranges, float(log.max_range))
    active = jnp.asarray(np.arange(size) < len(chunk))
    state, history = run(filt, state, controls, scans, valid, active=active, keep=_keep, key=key)
    return state, jax.tree.map(np.asarray, history)


@eqx.filter_jit
def _below_limit(ranges: Float[Array, "t b"], limit: float) -> Bool[Array, "t b"]:
    return ranges < 0.999 * limit


def _is_sure(history: Any, place: int, config: Config) -> bool:
    """Whether a scan leaves one small cluster."""
    belief = history.infos.place
    variance = belief.pose.covariance[place, 0, 0] + belief.pose.covariance[place, 1, 1]
    good = belief.mass[place] >= config.found_mass and variance <= config.found_spread**2
    return bool(good and history.infos.inject[place] <= config.lost_share)


def _resize(filt: MonteCarloLocalization, state: LocalizationState, last: Step, config: Config) -> LocalizationState:
    """Few particles where the robot is found, many where it is lost."""
    wanted = state.particles.size
    if last.inject > config.lost_share:
        wanted = config.num_particles_global
    elif last.found:
        wanted = config.num_particles
    if wanted == state.particles.size:
        return state
    return filt.resize(state, wanted, key=jax.random.fold_in(jax.random.key(config.seed + 1), last.index))


def _step(history: Any, place: int, index: int, log: Any, found: bool, size: int) -> Step:
    infos = history.infos
    mean = infos.place.pose.mean
    heading = np.arctan2(mean.rotation.sin[place], mean.rotation.cos[place])
    return Step(
        index=index,
        time=float(log.times[index]),
        pose=np.array([*mean.translation[place], heading], dtype=np.float64),
        covariance=infos.place.pose.covariance[place].astype(np.float64),
        mass=float(infos.place.mass[place]),
        updated=True,
        ess=float(infos.ess[place]),
        inject=float(infos.inject[place]),
        num_particles=size,
        found=found,
        cloud=history.states.cloud[place],
    )


def _carried(last: Step, log: Any, index: int) -> Step:
    """A scan that was not used: odometry carries the pose on."""
    moved = relative_poses(log.odometry[last.index][None], log.odometry[index][None])[0]
    pose = compose_poses(last.pose[None], moved[None])[0]
    pose[2] = (pose[2] + np.pi) % (2.0 * np.pi) - np.pi
    return Step(
        index=index,
        time=float(log.times[index]),
        pose=pose,
        covariance=last.covariance,
        mass=last.mass,
        updated=False,
        ess=last.ess,
        inject=last.inject,
        num_particles=last.num_particles,
        found=last.found,
        cloud=np.zeros((0, 3), np.float32),
    )
