"""Monte Carlo localization of a robot by laser scans in an occupancy map, from anywhere or from a known pose.

Host code that drives `MonteCarloLocalization`, and adapts the number of particles: many until the robot is localized,
few while it is, many again when scans stop fitting.
"""

from collections.abc import Iterable, Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float64, Key

from jaxloc._jit import filter_jit
from jaxloc.beliefs import Gaussian
from jaxloc.beliefs.particles import finite_log_weights
from jaxloc.beliefs.resampling.indices import systematic
from jaxloc.filters import MonteCarloLocalization, Recovery
from jaxloc.filters import run as run_filter
from jaxloc.filters.localization import LocalizationState
from jaxloc.poses import SE2
from jaxloc.poses.planar import compose_poses, relative_poses
from jaxloc.sensors import DistanceField, LaserScan, LikelihoodField, OccupancyMap, OdometryMotion

_CLOUD = 600  # particles in an output, for figures
_STREAK = 3  # scans in a row that must agree before the robot counts as localized


class Odometry(eqx.Module):
    """Noise of the odometry; see `OdometryMotion`.

    Attributes:
        turn_turn: rad for a rad of turn.
        turn_drive: rad for a meter.
        drive_drive: m for a meter.
        drive_turn: m for a rad.
        turn_floor: rad a step.
        drive_floor: m a step.
        slip: probability that the wheels slip in a step.
        slip_scale: standard deviation of the distance in such a step, as a fraction of it.
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
        num_particles: number of particles while the robot is localized.
        num_particles_global: the same while it is not.
        num_beams: number of beams of a scan that are used.
        sigma: standard deviation of the end points of beams about the walls, m.
        z_hit: probability that a beam ends at a wall of the map.
        independent_beams: number of independent measurements that a scan is worth.
        max_range: longer beams are ignored, m.
        odometry: its noise.
        min_translation: a scan is used when the robot has moved at least so far since the last one, m,
        min_rotation: or turned so far, rad.
        least_ess: least effective sample size after a scan, as a fraction of the particles.
        initial_translation: standard deviation of a given initial pose, m.
        initial_rotation: the same, rad.
        found_mass: the robot is localized when one cluster holds at least this fraction of the weight,
        found_sigma: and its standard deviation is at most this, m.
        lost_share: many particles again when a greater fraction is to be replaced by random ones.
        chunk: number of used scans after which the number of particles is adapted.
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
    initial_translation: float = 0.3
    initial_rotation: float = 0.2
    found_mass: float = 0.95
    found_sigma: float = 0.3
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


class Scan(eqx.Module):
    """One laser scan with the odometry at its time.

    Attributes:
        time: stamp, s.
        ranges: m; non-finite values are ignored.
        odometry: pose (x, y, heading) by odometry, in a frame of its own, m and rad.
    """

    time: float
    ranges: np.ndarray
    odometry: Float64[np.ndarray, "3"]


class Output(eqx.Module):
    """Estimated pose at one scan.

    Attributes:
        index: number of the scan, from 0.
        time: stamp, s.
        pose: (x, y, heading) of the robot in the map, m and rad.
        covariance: of the pose, right tangent (x and y of the robot, heading); that of the last scan that was used.
        mass: fraction of the weight in the cluster that the pose is the mean of.
        updated: whether this scan was used; otherwise odometry carried the pose on from the last one.
        ess: effective sample size.
        inject: fraction of the particles that is to be replaced by random ones.
        num_particles: number of particles.
        found: whether the robot is localized: at this scan and at the used ones before.
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


class State(eqx.Module):
    """State of the localization between two scans.

    Attributes:
        config: options.
        filter: the particle filter, with the map.
        belief: its state.
        laser: (angle of the first beam, increment, greatest range), rad and m.
        key: of the filter's steps.
        last: output of the last scan that was used.
        odometry: pose by odometry at that scan.
        num_scans: number of scans so far.
        num_used: number of used scans so far.
        streak: number of used scans in a row with one small cluster.
    """

    config: Config
    filter: MonteCarloLocalization
    belief: LocalizationState
    laser: tuple[float, float, float]
    key: Key[Array, ""]
    last: Output
    odometry: Float64[np.ndarray, "3"]
    num_scans: int
    num_used: int
    streak: int


def init(config: Config, grid: OccupancyMap, laser: Any, *, initial: SE2 | None = None) -> State:
    """The state before the first scan.

    Args:
        config: options.
        grid: the map.
        laser: record with ``mount`` (x, y, heading of the laser on the robot), ``angle_min``, ``angle_increment`` and
            ``max_range``, such as a `LaserLog`.
        initial: pose at the first scan; anywhere in the free space where not given.

    Raises:
        ValueError: the map has no obstacle or no free cell.
    """
    filt = make_filter(laser, grid, config)
    key_initial, key_run = jax.random.split(jax.random.key(config.seed))
    if initial is None:
        belief = filt.init_globally(config.num_particles_global, key=key_initial)
    else:
        sigmas = jnp.array([config.initial_translation, config.initial_translation, config.initial_rotation])
        belief = filt.init_near(Gaussian(initial, jnp.diag(sigmas**2)), config.num_particles, key=key_initial)
    zero = np.zeros(3)
    nothing = np.zeros((0, 3), np.float32)
    last = Output(-1, 0.0, zero, np.zeros((3, 3)), 0.0, False, 0.0, 0.0, belief.particles.size, False, nothing)
    beams = (float(laser.angle_min), float(laser.angle_increment), float(laser.max_range))
    return State(config, filt, belief, beams, key_run, last, zero, 0, 0, 0)


def step(state: State, scan: Scan) -> tuple[State, Output]:
    """Estimates the pose at the next scan.

    A scan is used when the robot has moved enough since the last one that was; otherwise odometry carries the pose on.

    Args:
        state: from `init` or the last step.
        scan: with its odometry.

    Returns:
        The next state, and the output of this scan.

    Raises:
        ValueError: the odometry has non-finite values, or the ranges are no vector.

    References:
        Thrun, Burgard, Fox, *Probabilistic Robotics*, 2005, chapter 8 [R-11].
    """
    _check(scan)
    config, last = state.config, state.last
    if state.num_used and not _has_moved(scan.odometry, state.odometry, config.min_translation, config.min_rotation):
        output = _carried(last, state.odometry, scan, state.num_scans)
        return eqx.tree_at(lambda s: s.num_scans, state, state.num_scans + 1), output
    belief = state.belief
    if state.num_used and state.num_used % config.chunk == 0:
        belief = _resize(state.filter, belief, last, config)
    before = state.odometry if state.num_used else scan.odometry
    belief, history = _update(state, belief, before, scan)
    streak = state.streak + 1 if _is_localized(history, config) else 0
    output = _output(history, scan, state.num_scans, streak >= _STREAK, belief.particles.size)
    counts = (state.num_scans + 1, state.num_used + 1, streak)
    return State(config, state.filter, belief, state.laser, state.key, output, scan.odometry, *counts), output


def run(log: Any, config: Config, grid: OccupancyMap, *, initial: SE2 | None = None) -> Iterator[Output]:
    """Localizes a robot in a recording, see `step`.

    Args:
        log: a `LaserLog`, or any record with its fields.
        config: options.
        grid: the map.
        initial: pose at the first scan; anywhere in the free space where not given.

    Yields:
        An output for each scan, the first included.

    Raises:
        ValueError: the map has no obstacle or no free cell.
    """
    state = init(config, grid, log, initial=initial)
    for scan in scans(log):
        state, output = step(state, scan)
        yield output


def scans(log: Any) -> Iterable[Scan]:
    """The scans of a `LaserLog`, one by one."""
    for time, ranges, odometry in zip(log.times, log.ranges, log.odometry, strict=True):
        yield Scan(float(time), ranges, odometry)


def make_filter(laser: Any, grid: OccupancyMap, config: Config) -> MonteCarloLocalization:
    """The particle filter for a laser in a map.

    Args:
        laser: for its mount on the robot.
        grid: the map.
        config: options.

    Returns:
        The filter.

    Raises:
        ValueError: the map has no obstacle or no free cell.
    """
    if not bool(jnp.any(grid.occupied)):
        raise ValueError("The map has no obstacle: there is nothing to localize by.")
    options = config.odometry
    names = [name for name in vars(Odometry()) if not name.startswith("_")]
    motion = OdometryMotion(**{name: getattr(options, name) for name in names})
    field = DistanceField.of(grid, ceiling=max(6.0 * config.sigma, 0.5), surfaces=True)
    sensor = LikelihoodField(
        field,
        SE2(*laser.mount),
        sigma=config.sigma,
        z_hit=config.z_hit,
        max_range=config.max_range,
        independent_beams=config.independent_beams,
    )
    recovery = Recovery(readings=min(config.independent_beams, float(config.num_beams)))
    return MonteCarloLocalization(motion, sensor, grid.free_space(), least_ess=config.least_ess, recovery=recovery)


class _Cloud(eqx.Module):
    """What the history of the filter holds of a state."""

    cloud: Float[Array, "m 3"]


def _draw_cloud(state: LocalizationState) -> _Cloud:
    particles = state.particles
    drawn = particles.take(systematic(jax.random.key(0), finite_log_weights(particles), _CLOUD))
    heading = jnp.arctan2(drawn.rotation.sin, drawn.rotation.cos)
    return _Cloud(jnp.concatenate([drawn.translation, heading[:, None]], axis=1))


def _check(scan: Scan) -> None:
    if np.ndim(scan.ranges) != 1:
        raise ValueError(f"The ranges of a scan have shape {np.shape(scan.ranges)}: give a vector.")
    if not np.isfinite(scan.odometry).all():
        raise ValueError(f"The odometry of a scan is {scan.odometry}: give finite numbers (x, y, heading).")


def _has_moved(odometry: np.ndarray, before: np.ndarray, min_translation: float, min_rotation: float) -> bool:
    motion = odometry - before
    turn = abs((motion[2] + np.pi) % (2.0 * np.pi) - np.pi)
    return bool(np.hypot(motion[0], motion[1]) >= min_translation or turn >= min_rotation)


def _update(state: State, belief: LocalizationState, before: np.ndarray, scan: Scan) -> tuple[LocalizationState, Any]:
    """The filter over one scan."""
    first, increment, limit = state.laser
    motions = relative_poses(before[None], scan.odometry[None]).astype(np.float32)
    controls = jax.vmap(SE2)(*jnp.asarray(motions).T)
    readings = LaserScan(jnp.asarray(scan.ranges)[None], first, increment).thin(state.config.num_beams)
    valid = _below_limit(readings.ranges, limit)
    belief, history = run_filter(state.filter, belief, controls, readings, valid, keep=_draw_cloud, key=state.key)
    return belief, jax.tree.map(np.asarray, history)


@filter_jit
def _below_limit(ranges: Float[Array, "t b"], limit: float) -> Bool[Array, "t b"]:
    return ranges < 0.999 * limit


def _is_localized(history: Any, config: Config) -> bool:
    """Whether a scan leaves one small cluster."""
    place = history.infos.place
    variance = place.pose.covariance[0, 0, 0] + place.pose.covariance[0, 1, 1]
    good = place.mass[0] >= config.found_mass and variance <= config.found_sigma**2
    return bool(good and history.infos.inject[0] <= config.lost_share)


def _resize(filt: MonteCarloLocalization, state: LocalizationState, last: Output, config: Config) -> LocalizationState:
    """Few particles where the robot is localized, many where it is lost."""
    wanted = state.particles.size
    if last.inject > config.lost_share:
        wanted = config.num_particles_global
    elif last.found:
        wanted = config.num_particles
    if wanted == state.particles.size:
        return state
    return filt.resize(state, wanted, key=jax.random.fold_in(jax.random.key(config.seed + 1), last.index))


def _output(history: Any, scan: Scan, index: int, found: bool, size: int) -> Output:
    infos = history.infos
    mean = infos.place.pose.mean
    heading = np.arctan2(mean.rotation.sin[0], mean.rotation.cos[0])
    return Output(
        index=index,
        time=scan.time,
        pose=np.array([*mean.translation[0], heading], dtype=np.float64),
        covariance=infos.place.pose.covariance[0].astype(np.float64),
        mass=float(infos.place.mass[0]),
        updated=True,
        ess=float(infos.ess[0]),
        inject=float(infos.inject[0]),
        num_particles=size,
        found=found,
        cloud=history.states.cloud[0],
    )


def _carried(last: Output, before: np.ndarray, scan: Scan, index: int) -> Output:
    """The output of a scan that was not used: odometry carries the pose on."""
    moved = relative_poses(before[None], scan.odometry[None])[0]
    pose = compose_poses(last.pose[None], moved[None])[0]
    pose[2] = (pose[2] + np.pi) % (2.0 * np.pi) - np.pi
    nothing = np.zeros((0, 3), np.float32)
    counts = (last.mass, False, last.ess, last.inject, last.num_particles, last.found, nothing)
    return Output(index, scan.time, pose, last.covariance, *counts)
