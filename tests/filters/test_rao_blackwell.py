"""FastSLAM: its limit of one particle, paths by ancestors, robustness, and EKF-SLAM beside it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.beliefs import Gaussian
from jaxloc.data.simulate.landmarks import simulate_landmarks
from jaxloc.filters import run
from jaxloc.filters.rao_blackwell import FastSlam, FromMotion, FromReading, trace_back
from jaxloc.poses import SE2, SO2
from jaxloc.sensors import IncrementMotion, RangeBearing

DEVIATIONS = (0.1, 0.03)


def motion():
    return IncrementMotion(drive=0.05, side=0.02, turn_drive=0.01, turn_turn=0.02)


def fast(num_particles=100, capacity=8, proposal=FromReading(), still=False):
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

        return worlds, {type(p).__name__: solve(fast(proposal=p)) for p in (FromMotion(), FromReading())}


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


def test_maps_are_near_those_of_ekf_slam(laps, x64):
    """100 particles around a loop lose some of what one Gaussian keeps, and no more than that."""
    worlds, answers = laps
    first, second = (map_error(worlds, answers[name][0]) for name in ("FromMotion", "FromReading"))
    rival = ekf_slam_error(worlds)
    assert max(first, second) < 1.6 * rival
    for _, infos, _, _ in answers.values():
        assert bool(infos.ok.all()) and np.isfinite(infos.log_likelihood).all()
    # The better proposal keeps more particles alive.
    effective = [np.asarray(answers[name][1].ess).mean() for name in ("FromMotion", "FromReading")]
    assert effective[1] > effective[0]


def test_traced_paths_end_in_the_last_poses(laps, x64):
    _, answers = laps
    end, infos, path, poses = answers["FromReading"]
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


def test_unknown_numbers_make_one_landmark_each(x64):
    filt = fast(num_particles=20, capacity=2)
    state = filt.init(start())
    for i in range(12):
        distance, bearing = (3.0, 0.2) if i % 2 else (5.0, -1.0)
        state, _ = filt.update(state, reading(distance, bearing, -1), jnp.array(True), key=jax.random.key(i))
    assert state.maps.seen.sum(axis=1).tolist() == [2] * 20
    assert int(state.maps.support.sum()) == 20 * 12


def test_bad_readings_change_nothing(dtype):
    filt = fast(num_particles=20, capacity=2)
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
