"""Monte Carlo localization in a simulated building and on a real recording. Inventory: R-11."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2

from jaxloc.beliefs import Gaussian, KLDSize, Particles, Sensor
from jaxloc.data import carmen, ros_map, simulate_laser_drive
from jaxloc.filters import MonteCarloLocalization, Recovery, run
from jaxloc.filters.localization import find_place
from jaxloc.poses import SE2
from jaxloc.poses.planar import relative_poses
from jaxloc.sensors import DistanceField, LaserScan, LikelihoodField, OdometryMotion

STEPS, PARTICLES = 40, 10_000


def step_of(state):
    """Keeps no clouds; one function, for a new one each time would compile anew."""
    return state.step


def stack(poses):
    return jax.vmap(SE2)(*jnp.asarray(poses, jnp.float32).T)


def make_filter(grid, mount, **options):
    field = DistanceField.of(grid, ceiling=0.6, surfaces=True)
    sensor = LikelihoodField(field, SE2(*mount), sigma=0.1, max_range=30.0, independent_beams=15.0)
    motion = OdometryMotion(drive_turn=0.1, turn_floor=0.02, drive_floor=0.02, slip=0.1)
    return MonteCarloLocalization(motion, sensor, grid.free_space(), recovery=Recovery(readings=15.0), **options)


class World:
    """A filter and what it is to be run on."""

    def __init__(self, filt, log, truth):
        self.filt, self.truth = filt, truth
        self.scans = log.scans().thin(60)
        self.motions = np.concatenate([np.zeros((1, 3)), relative_poses(log.odometry[:-1], log.odometry[1:])])

    def run(self, state, steps, key, active=None):
        """Errors of the position, of the heading in degrees, and the history, over some steps."""
        chosen = jax.tree.map(lambda leaf: leaf[steps], self.scans)
        valid = jnp.ones(chosen.ranges.shape, bool)
        active = jnp.ones(len(steps), bool) if active is None else active
        state, history = run(
            self.filt, state, stack(self.motions[steps]), chosen, valid, active=active, keep=step_of, key=key
        )
        mean = history.infos.place.pose.mean
        poses = np.column_stack([mean.translation, np.arctan2(mean.rotation.sin, mean.rotation.cos)])
        errors = relative_poses(poses.astype(float), self.truth[steps])
        return state, history, np.hypot(errors[:, 0], errors[:, 1]), np.degrees(np.abs(errors[:, 2]))

    def init_near(self, index, key, count=PARTICLES):
        pose = SE2(*(float(value) for value in self.truth[index]))
        return self.filt.init_near(Gaussian(pose, jnp.diag(jnp.array([0.04, 0.04, 0.01]))), count, key=key)


@pytest.fixture(scope="module")
def world():
    drive = simulate_laser_drive(seed=3)
    return World(make_filter(drive.building.map(), drive.log.mount), drive.log, drive.truth)


@pytest.fixture(scope="module")
def tracked(world):
    key = jax.random.key(1)
    return world.run(world.init_near(0, jax.random.key(0)), np.arange(STEPS), key)


def test_a_known_initial_pose_is_tracked_with_consistent_covariances(world, tracked):
    _, history, position, heading = tracked
    assert np.median(position) < 0.04 and np.percentile(position, 95) < 0.1 and np.median(heading) < 0.6
    assert (history.infos.place.mass > 0.99).mean() > 0.9 and history.infos.ok.all()
    place = history.infos.place.pose
    nees = jax.vmap(lambda g, truth: g.mahalanobis_squared(truth))(place, stack(world.truth[:STEPS]))
    # The autocorrelation is about 0.4, so that 40 steps count as 17; covariances are at most three times too large.
    assert 3.0 / 3.0 < float(jnp.mean(nees)) < chi2.ppf(0.999, 3 * 17) / 17


@pytest.mark.slow
def test_global_localization_finds_the_robot(world):
    ends = []
    for seed in range(3):
        state = world.filt.init_globally(PARTICLES, key=jax.random.key(seed))
        _, history, position, _ = world.run(state, np.arange(30, 30 + STEPS), jax.random.key(seed + 10))
        ends.append(position[-10:].max())
        # No scan leaves fewer particles than asked for, although the first would leave a handful.
        assert history.infos.ess.min() >= 0.99 * 0.01 * PARTICLES and history.infos.exponent[0] < 0.9
    assert max(ends) < 0.25


def test_a_kidnapped_robot_is_found_again(world):
    steps = np.r_[0:20, 140 : 140 + STEPS - 20]
    _, history, position, _ = world.run(world.init_near(0, jax.random.key(0)), steps, jax.random.key(2))
    assert position[:20].max() < 0.5 and position[-5:].max() < 0.3
    inject = np.asarray(history.infos.inject)
    assert inject[20:].max() > 0.1 and inject[:20].max() < 0.1


@pytest.mark.slow
def test_runs_resume_to_the_same_numbers(world, tracked):
    key = jax.random.key(1)
    state, steps = world.init_near(0, jax.random.key(0)), np.arange(STEPS)
    # A step that is not active changes nothing, so that both halves have the shape of the whole.
    half, _, first, _ = world.run(state, steps, key, active=jnp.asarray(steps < 25))
    rolled = np.concatenate([steps[25:], steps[:25]])
    whole, _, second, _ = world.run(half, rolled, key, active=jnp.asarray(np.arange(STEPS) < STEPS - 25))
    np.testing.assert_array_equal(np.concatenate([first[:25], second[: STEPS - 25]]), tracked[2])
    for one, other in zip(jax.tree.leaves(whole), jax.tree.leaves(tracked[0]), strict=True):
        np.testing.assert_array_equal(one, other)


def test_scans_that_are_not_valid_change_nothing(world, tracked):
    state = tracked[0]
    scan = jax.tree.map(lambda leaf: leaf[5], world.scans)
    after, info = world.filt.update(state, scan, jnp.zeros(scan.ranges.shape, bool))
    for one, other in zip(jax.tree.leaves(after), jax.tree.leaves(state), strict=True):
        np.testing.assert_array_equal(one, other)
    assert float(info.log_likelihood) == 0.0 and bool(info.ok)


class Refusing(Sensor):
    """A sensor that no pose fits."""

    value: jax.Array

    def expect(self, state, measurement):
        return measurement

    def covariance(self, state, measurement):
        return jnp.eye(1)

    def log_prob(self, state, measurement, valid):
        return self.value + 0.0 * state.translation[0]


@pytest.mark.parametrize("value", [-jnp.inf, jnp.nan])
def test_measurements_that_fit_nowhere_are_no_error(world, tracked, value):
    filt = eqx.tree_at(lambda f: f.sensor, world.filt, Refusing(jnp.asarray(value)))
    after, info = filt.update(tracked[0], jnp.zeros(1), jnp.array(True))
    assert not info.ok and float(info.log_likelihood) == 0.0 and float(info.inject) == 0.5
    np.testing.assert_array_equal(after.particles.values.translation, tracked[0].particles.values.translation)
    again = filt.predict(after, SE2(0.0, 0.0, 0.0), key=jax.random.key(0))
    moved = jnp.hypot(*(again.particles.values.translation - after.particles.values.translation).T) > 1.0
    assert 0.3 < float(moved.mean()) < 0.6  # half of the particles are random now
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(again) if eqx.is_inexact_array(leaf))


def test_resizing_keeps_the_density(world, tracked):
    state = tracked[0]
    small = world.filt.resize(state, 500, key=jax.random.key(0))
    assert small.particles.size == 500
    a, b = state.estimate().pose, small.estimate().pose
    np.testing.assert_allclose(a.mean.translation, b.mean.translation, atol=0.02)
    np.testing.assert_allclose(np.sqrt(np.diag(a.covariance)), np.sqrt(np.diag(b.covariance)), rtol=0.2)


def test_adaptive_sizes_mask_particles(world):
    filt = make_filter(
        simulate_laser_drive(seed=3).building.map(), (0.1, 0.0, 0.0), adaptive=KLDSize(jnp.array([0.2, 0.2, 0.1]))
    )
    state = filt.init_globally(PARTICLES, key=jax.random.key(0))
    counts = []
    for index in range(12):
        scan = jax.tree.map(lambda leaf, index=index: leaf[index + 30], world.scans)
        state = filt.predict(state, SE2(*world.motions[index + 30]), key=jax.random.key(index))
        state, _ = filt.update(state, scan, jnp.ones(scan.ranges.shape, bool))
        counts.append(int(state.particles.count))
    assert counts[0] == PARTICLES and 100 <= counts[-1] < PARTICLES / 4
    assert np.hypot(*(np.asarray(state.estimate().pose.mean.translation) - world.truth[41, :2])) < 0.3


def test_the_heaviest_cluster(rng):
    heavy = rng.normal([3.0, -2.0, 3.1], [0.1, 0.1, 0.1], (600, 3))
    light = rng.normal([-5.0, 4.0, 0.0], [0.1, 0.1, 0.1], (900, 3))
    weights = np.concatenate([np.full(600, 0.7 / 600), np.full(900, 0.3 / 900)])
    place = find_place(Particles(stack(np.concatenate([heavy, light])), jnp.asarray(np.log(weights), jnp.float32)))
    assert float(place.mass) == pytest.approx(0.7, abs=0.01)
    np.testing.assert_allclose(place.pose.mean.translation, heavy[:, :2].mean(axis=0), atol=1e-3)
    # Headings about half a turn have no jump; the covariance is that of the cluster, in its own frame.
    assert abs(float(place.pose.mean.theta)) == pytest.approx(3.1, abs=0.02)
    np.testing.assert_allclose(np.diag(place.pose.covariance), 0.01, rtol=0.2)


def test_double_precision_is_kept(x64):
    drive = simulate_laser_drive(seed=3)
    grid = drive.building.map()
    grid = type(grid)(grid.probability.astype(jnp.float64), 0.05, SE2(jnp.asarray(-0.5), -0.5, 0.0))
    field = DistanceField.of(grid)
    filt = MonteCarloLocalization(OdometryMotion(dtype=jnp.float64), LikelihoodField(field), grid.free_space())
    state = filt.init_globally(64, key=jax.random.key(0))
    state = filt.predict(state, SE2(jnp.asarray(0.1), 0.0, 0.0), key=jax.random.key(1))
    scan = LaserScan(jnp.asarray(drive.log.ranges[0], jnp.float64), -1.57, 0.0174)
    state, info = filt.update(state, scan, jnp.array(True))
    leaves = [leaf for leaf in jax.tree.leaves((state, info)) if eqx.is_inexact_array(leaf)]
    assert {str(leaf.dtype) for leaf in leaves} == {"float64"}


def test_wrong_arguments(world):
    with pytest.raises(TypeError, match="Gaussian"):
        world.filt.init(Gaussian(SE2(0.0, 0.0, 0.0), jnp.eye(3)))
    with pytest.raises(ValueError, match="need a key"):
        world.filt.predict(world.init_near(0, jax.random.key(0)), SE2(0.0, 0.0, 0.0))


def test_share_of_random_poses_follows_the_fit():
    recovery = Recovery(slow=0.05, fast=0.5, tolerance=0.2)
    mean, seen = jnp.zeros(2), 0
    for seen in range(40):
        mean = recovery.smooth(mean, jnp.array(1.0), jnp.array(seen))
    np.testing.assert_allclose(mean, 1.0, rtol=1e-6)
    assert float(recovery.share(mean)) == 0.0
    mean = recovery.smooth(mean, jnp.array(-1.0), jnp.array(40))
    np.testing.assert_allclose(mean, [0.9, 0.0], atol=1e-6)
    assert float(recovery.share(mean)) == pytest.approx(1 - np.exp(-0.7), abs=1e-6)


@pytest.mark.slow
@pytest.mark.recordings
def test_a_real_building(recordings):
    folder = recordings / "mcl_fr079"
    keyframes = np.load(folder / "keyframes.npz")
    log = carmen.read_log(folder / "fr079_corrected.log.gz")
    # The map was made of the even keyframes: the odd ones are new to it. Odometry is the raw one.
    log = eqx.tree_at(lambda record: record.odometry, log, keyframes["odom"])
    odd = eqx.tree_at(lambda r: (r.ranges, r.odometry), log, (log.ranges[1::2], log.odometry[1::2]))
    filt = make_filter(ros_map.read_map(folder / "map_from_even_scans.yaml"), log.mount)
    world = World(filt, odd, keyframes["ref"][1::2])
    _, _, position, heading = world.run(
        world.init_near(0, jax.random.key(0), 2000), np.arange(len(odd.odometry)), jax.random.key(1)
    )
    assert np.median(position) <= 0.05 and np.median(heading) <= 0.65 and np.percentile(position, 95) <= 0.25
