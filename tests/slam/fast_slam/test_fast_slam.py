"""FastSLAM: its limit of one particle, paths by ancestors, robustness, and EKF-SLAM beside it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.beliefs import Gaussian
from jaxloc.data.simulate.landmarks import simulate_landmarks
from jaxloc.filters import run
from jaxloc.poses import SE2, SO2, local
from jaxloc.sensors import Increment, IncrementMotion, RangeBearing
from jaxloc.slam.fast_slam import BlockProposal, FastSlam, MeasurementProposal, MotionProposal, trace_back
from jaxloc.slam.fast_slam.proposals import Particle

DEVIATIONS = (0.1, 0.03)


def motion():
    return IncrementMotion(drive=0.05, side=0.02, turn_drive=0.01, turn_turn=0.02)


def fast(num_particles=100, capacity=8, proposal=MeasurementProposal(), still=False):
    model = IncrementMotion(drive=0.0, side=0.0, idle=0.0, turn_drive=0.0, turn_turn=0.0, turn_idle=0.0)
    return FastSlam(
        model if still else motion(), *DEVIATIONS, num_particles=num_particles, capacity=capacity, proposal=proposal
    )


def start(sigma=1e-6):
    return Gaussian(SE2(0.0, 0.0, 0.0), sigma**2 * jnp.eye(3))


def reading(distance, bearing, landmark):
    return RangeBearing(jnp.asarray(distance, float), SO2.from_angle(jnp.asarray(bearing, float)), jnp.array(landmark))


@pytest.fixture(scope="module")
def laps():
    """Drives around landmarks that are always in sight, and what either proposal makes of them."""
    with jax.enable_x64(True):
        keys = jax.random.split(jax.random.key(1), 16)

        def world_of(key):
            return simulate_landmarks(
                motion(), jnp.array(DEVIATIONS), key=key, num_steps=80, num_landmarks=8, laps=1.0, reach=20.0
            )

        worlds = jax.jit(jax.vmap(world_of))(keys)

        def solve(filt):
            def one(world, key):
                drive = (world.increments, world.readings, world.valid)
                end, history = run(filt, filt.init(start()), *drive, keep=lambda state: state.poses, key=key)
                path = trace_back(history.states, history.infos.ancestors, end.best())
                return end, history.infos, path, history.states

            return jax.jit(jax.vmap(one))(worlds, keys)

        return worlds, {
            type(p).__name__: solve(fast(proposal=p))
            for p in (MotionProposal(), MeasurementProposal(), BlockProposal(40))
        }


def map_error(worlds, end):
    weights = jnp.exp(end.log_weights)
    maps = jnp.sum(weights[:, :, None, None] * end.maps.means, axis=1)
    return np.sqrt(np.mean(np.sum(np.asarray(maps - worlds.landmarks) ** 2, axis=-1)))


def ekf_slam_error(worlds):
    """EKF-SLAM lives a floor above filters: its maps of the same drives are the rival."""
    from jaxloc.slam.ekf_slam import EkfSlam

    filt = EkfSlam(motion(), *DEVIATIONS, capacity=8)

    def one(world):
        return run(filt, filt.init(start()), world.increments, world.readings, world.valid, keep=lambda s: s.step)[0]

    ends = jax.jit(jax.vmap(one))(worlds)
    return np.sqrt(np.mean(np.sum(np.asarray(ends.landmarks - worlds.landmarks) ** 2, axis=-1)))


@pytest.mark.slow
def test_maps_are_near_those_of_ekf_slam(laps, x64):
    """100 particles around a loop lose some of what one Gaussian keeps, and no more than that."""
    worlds, answers = laps
    first, second = (map_error(worlds, answers[name][0]) for name in ("MotionProposal", "MeasurementProposal"))
    rival = ekf_slam_error(worlds)
    assert max(first, second) < 1.6 * rival
    # Poses that are drawn twice, not eighty times, lose less.
    assert map_error(worlds, answers["BlockProposal"][0]) < min(1.2 * rival, first, second)
    for _, infos, _, _ in answers.values():
        assert bool(infos.ok.all()) and np.isfinite(infos.log_likelihood).all()
    # The better proposal keeps more particles alive.
    effective = [
        np.asarray(answers[name][1].ess).mean() for name in ("MotionProposal", "MeasurementProposal", "BlockProposal")
    ]
    assert effective[2] > effective[1] > effective[0]


@pytest.mark.slow
def test_traced_paths_end_in_the_last_poses(laps, x64):
    _, answers = laps
    end, infos, path, poses = answers["MeasurementProposal"]
    for run_index in (0, 7):
        best = int(jnp.argmax(end.log_weights[run_index]))
        ancestors = np.asarray(infos.ancestors[run_index])
        particle, steps = best, []
        for t in range(len(ancestors) - 1, -1, -1):
            steps.append(np.asarray(poses.translation[run_index, t, particle]))
            particle = ancestors[t, particle]
        np.testing.assert_allclose(path.translation[run_index], np.array(steps[::-1]))


def test_with_a_known_path_each_landmark_is_a_kalman_filter(x64, rng):
    """R-17, R-20: with no motion noise one particle is exact: information of linearized readings adds up."""
    filt = fast(num_particles=1, capacity=1, still=True)
    state = filt.init(start(0.0))
    truth, information, total = np.array([3.0, 2.0]), np.zeros((2, 2)), np.zeros(2)
    for i in range(30):
        offset = truth
        distance, angle = np.linalg.norm(offset), np.arctan2(offset[1], offset[0])
        noise = rng.normal(size=2) * DEVIATIONS
        state, info = filt.update(
            state, reading(distance + noise[0], angle + noise[1], 0), jnp.array(True), key=jax.random.key(i)
        )
        assert bool(info.ok)
        polar = np.array([offset / distance, np.array([-offset[1], offset[0]]) / distance**2])
        weight = polar.T @ np.diag(1.0 / np.square(DEVIATIONS)) @ polar
        information += weight
        total += weight @ (truth + np.linalg.solve(polar, noise))
    np.testing.assert_allclose(state.maps.covariances[0, 0], np.linalg.inv(information), rtol=0.05, atol=5e-6)
    np.testing.assert_allclose(state.landmarks()[0], np.linalg.solve(information, total), atol=0.01)


@pytest.mark.parametrize("proposal", [MeasurementProposal(), BlockProposal(5)])
def test_unknown_numbers_make_one_landmark_each(x64, proposal):
    filt = fast(num_particles=20, capacity=2, proposal=proposal)
    state = filt.init(start())
    for i in range(12):
        distance, bearing = (3.0, 0.2) if i % 2 else (5.0, -1.0)
        state, _ = filt.update(state, reading(distance, bearing, -1), jnp.array(True), key=jax.random.key(i))
    assert state.maps.seen.sum(axis=1).tolist() == [2] * 20
    assert int(state.maps.support.sum()) == 20 * 12


@pytest.mark.parametrize("proposal", [MeasurementProposal(), BlockProposal(5)])
def test_bad_readings_change_nothing(dtype, proposal):
    filt = fast(num_particles=20, capacity=2, proposal=proposal)
    state, _ = filt.update(filt.init(start()), reading(2.0, 0.3, 0), jnp.array(True), key=jax.random.key(0))
    bad_readings = ((reading(jnp.nan, 0.3, 1), True), (reading(2.0, jnp.inf, 1), True), (reading(5.0, 1.0, 1), False))
    beyond = (reading(5.0, 1.0, 2), True)  # the map has room for numbers 0 and 1
    for bad, valid in (*bad_readings, beyond):
        after, info = filt.update(state, bad, jnp.array(valid), key=jax.random.key(1))
        assert all(jax.tree.leaves(jax.tree.map(lambda a, b: bool((a == b).all()), after, state)))
        assert float(info.log_likelihood) == 0.0 and bool(info.ok)


def test_a_false_identity_does_not_move_the_map(x64):
    filt = fast(num_particles=20, capacity=2)
    state = filt.init(start())
    for i in range(4):
        state, _ = filt.update(state, reading(2.0, 0.0, 0), jnp.array(True), key=jax.random.key(i))
    after, info = filt.update(state, reading(9.0, 2.0, 0), jnp.array(True), key=jax.random.key(9))
    assert bool(info.ok) and not bool(info.resampled)
    np.testing.assert_allclose(after.maps.means[:, 0], state.maps.means[:, 0])


def test_a_missing_key_is_said():
    filt = fast(num_particles=2, capacity=1)
    with pytest.raises(ValueError, match="key"):
        filt.update(filt.init(start()), reading(2.0, 0.0, 0), jnp.array(True))


class EkfSlamInNumpy:
    """EKF-SLAM as in a textbook, with Jacobians by differences."""

    def __init__(self, count):
        self.pose, self.points, self.seen = np.eye(3), np.zeros((count, 2)), np.zeros(count, bool)
        self.covariance = np.zeros((3 + 2 * count, 3 + 2 * count))

    def predict(self, increment, noise):
        self.pose = self.pose @ increment
        back = np.eye(len(self.covariance))
        inverse = np.linalg.inv(increment)
        back[:3, :3] = inverse
        back[:2, 2] = [inverse[1, 2], -inverse[0, 2]]  # adjoint of (translation, rotation)
        self.covariance = back @ self.covariance @ back.T
        self.covariance[:3, :3] += noise

    def update(self, z, number):
        if not self.seen[number]:
            return self.add(z, number)
        size, sigma = len(self.covariance), np.diag(np.square(DEVIATIONS))
        jacobian = differences(lambda d: self.expect(d, number), size)
        spread = jacobian @ self.covariance @ jacobian.T + sigma
        gain = self.covariance @ jacobian.T @ np.linalg.inv(spread)
        residual = z - self.expect(np.zeros(size), number)
        move = gain @ residual
        self.pose, self.points = self.pose @ matrix(move[:3]), self.points + move[3:].reshape(-1, 2)
        self.covariance = self.covariance - gain @ spread @ gain.T
        return -0.5 * residual @ np.linalg.solve(spread, residual) - 0.5 * np.log(np.linalg.det(2 * np.pi * spread))

    def expect(self, move, number):
        inside = np.linalg.inv(self.pose @ matrix(move[:3])) @ np.append(self.point(move, number), 1.0)
        return np.array([np.hypot(*inside[:2]), np.arctan2(inside[1], inside[0])])

    def point(self, move, number):
        return self.points[number] + move[3 + 2 * number : 5 + 2 * number]

    def add(self, z, number):
        def locate(pose_move, z):
            ray = np.array([z[0] * np.cos(z[1]), z[0] * np.sin(z[1]), 1.0])
            return (self.pose @ matrix(pose_move) @ ray)[:2]

        rows = slice(3 + 2 * number, 5 + 2 * number)
        by_pose = differences(lambda d: locate(d, z), 3)
        by_reading = differences(lambda d: locate(np.zeros(3), z + d), 2)
        cross = by_pose @ self.covariance[:3]
        self.covariance[rows], self.covariance[:, rows] = cross, cross.T
        own = by_reading @ np.diag(np.square(DEVIATIONS)) @ by_reading.T
        self.covariance[rows, rows] = cross[:, :3] @ by_pose.T + own
        self.points[number], self.seen[number] = locate(np.zeros(3), z), True
        return None


def differences(function, size, step=1e-6):
    return np.stack([(function(step * e) - function(-step * e)) / (2.0 * step) for e in np.eye(size)], axis=1)


def matrix(tangent):
    """exp of (translation, rotation) as a matrix, by its series."""
    x, y, angle = tangent
    generator, term, total = np.array([[0.0, -angle, x], [angle, 0.0, y], [0.0, 0.0, 0.0]]), np.eye(3), np.eye(3)
    for i in range(1, 20):
        term = term @ generator / i
        total = total + term
    return total


@pytest.fixture(scope="module")
def short_drive():
    """Sixty steps among three landmarks, as one particle in one block sees them."""
    with jax.enable_x64(True):
        world = simulate_landmarks(
            motion(), jnp.array(DEVIATIONS), key=jax.random.key(3), num_steps=60, num_landmarks=3, laps=1.0, reach=25.0
        )
        filt = fast(num_particles=1, capacity=3, proposal=BlockProposal(1000))
        drive = (world.increments, world.readings, world.valid)
        return world, run(filt, filt.init(start()), *drive, key=jax.random.key(0))


def test_one_long_block_is_ekf_slam(short_drive, x64):
    world, (end, history) = short_drive
    rival = EkfSlamInNumpy(3)
    rival.covariance[:3, :3] = 1e-12 * np.eye(3)
    step = jax.tree.map(lambda leaf: leaf[0], world.increments)
    increment = np.eye(3)
    increment[:2, :2], increment[:2, 2] = step.motion.rotation.matrix(), step.motion.translation
    noise = np.asarray(motion().covariance(world.poses, step))
    readings = np.stack([world.readings.range, jax.vmap(lambda b: b.angle())(world.readings.bearing)], axis=1)
    for t, (z, number) in enumerate(zip(readings, np.asarray(world.readings.landmark), strict=True)):
        rival.predict(increment, noise)
        density = rival.update(z, number)
        if density is not None:
            np.testing.assert_allclose(history.infos.log_likelihood[t], density, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(end.maps.means[0], rival.points, atol=1e-6)
    np.testing.assert_allclose(end.poses.translation[0], rival.pose[:2, 2], atol=1e-6)
    np.testing.assert_allclose(end.pending[0], rival.covariance, atol=1e-7)


def test_what_the_path_makes_uncertain_is_drawn(short_drive, x64):
    """Joint covariance = landmarks given the path + the draw, exactly: the law of total variance."""
    _, (_, history) = short_drive
    for t in (10, 59):
        state = jax.tree.map(lambda leaf, t=t: leaf[t], history.states)
        given = np.zeros((9, 9))
        for j in range(3):
            given[3 + 2 * j : 5 + 2 * j, 3 + 2 * j : 5 + 2 * j] = state.maps.covariances[0, j]
        joint = np.asarray(state.pending[0])
        assert np.linalg.eigvalsh(joint - given).min() > -1e-12
        one = Particle(*jax.tree.map(lambda leaf: leaf[0], (state.poses, state.pending, state.maps)))
        normal = jax.random.normal(jax.random.key(t), (20_000, 9))
        drawn = jax.jit(jax.vmap(BlockProposal(1000).draw, in_axes=(None, 0)))(one, normal)
        moves = jax.vmap(local, in_axes=(None, 0))(one.pose, drawn.pose)
        moves = np.concatenate([moves, (drawn.known.means - one.known.means[None]).reshape(-1, 6)], axis=1)
        scale = np.sqrt(np.outer(np.diag(joint), np.diag(joint)))
        np.testing.assert_allclose(np.cov(moves.T) / scale, (joint - given) / scale, atol=0.03)
        np.testing.assert_allclose(drawn.pending[0], given)


def test_a_block_draws_between_steps_and_needs_a_key():
    filt = fast(num_particles=3, capacity=1, proposal=BlockProposal(2))
    state, control = filt.init(start(0.1)), Increment(jnp.array(1.0), SE2(0.1, 0.0, 0.0))
    places = []
    for i in range(4):
        state = filt.predict(state, control, key=jax.random.key(i))
        places.append(len(set(state.poses.translation[:, 0].tolist())))
    assert places == [1, 1, 3, 3]
    with pytest.raises(ValueError, match="key"):
        filt.predict(state, control)
    with pytest.raises(ValueError, match="at least one step"):
        BlockProposal(0)
