import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.beliefs import Gaussian, Particles
from jaxloc.data.simulate.ceiling import drive_below, make_ceiling
from jaxloc.filters import ParticleFilter, run
from jaxloc.poses import chain
from jaxloc.sensors import CeilingSensor, OdometryMotion


@pytest.fixture(scope="module")
def museum():
    return make_ceiling(0)


def localizer(museum, noise, sigma):
    motion = OdometryMotion(
        turn_turn=0.05, turn_drive=noise, drive_drive=noise, drive_turn=0.01, turn_floor=0.002, drive_floor=0.003
    )
    return ParticleFilter(motion, CeilingSensor(museum, sigma))


def errors(positions, drive):
    return np.hypot(*np.moveaxis(np.asarray(positions) - np.asarray(drive.poses.translation), -1, 0))


def position(state):
    return state.particles.mean().translation


def follow(filt, drive, prior, key):
    valid = jnp.ones(drive.brightness.shape, bool)
    return run(filt, filt.init(prior), drive.odometry, drive.brightness, valid, keep=position, key=key)[1].states


def test_the_museum(museum):
    brightness = np.asarray(museum.brightness)
    assert brightness.shape == (401, 601) and brightness.dtype == np.float32
    assert brightness.min() >= 0.0 and brightness.max() <= 1.0 and brightness.std() > 0.1
    assert np.array_equal(brightness, make_ceiling(0).brightness)


def test_the_drive(museum):
    drive = drive_below(museum, 3, distance=50.0)
    assert drive.brightness.shape == (200,)
    positions = np.asarray(drive.poses.translation)
    assert np.allclose(np.hypot(*np.diff(positions, axis=0).T), 0.25, atol=0.01)
    assert positions.min() > 0.0 and np.all(positions.max(0) < [60.0, 40.0])
    reckoned = chain(drive.start, drive.odometry)
    drift = errors(reckoned.translation[-200:], drive)
    assert 0.3 < drift[-1] < 15.0
    off = np.asarray(museum.at(drive.poses.translation).values) - np.asarray(drive.brightness)
    assert np.median(np.abs(off)) < 0.04


@pytest.mark.slow
def test_a_thousand_particles_track_for_two_hundred_meters(museum):  # they end within 10 cm
    drives = [drive_below(museum, seed, step=0.1) for seed in range(3)]
    drives = jax.tree.map(lambda *leaves: jnp.stack(leaves), *drives)
    filt = localizer(museum, 0.05, 0.05)

    @jax.jit
    @jax.vmap
    def track(drive, key):
        prior = Gaussian(drive.start, jnp.diag(jnp.array([0.01, 0.01, 0.0025])))
        return follow(filt, drive, Particles.from_gaussian(prior, 1000, key=key), key)

    found = errors(track(drives, jax.random.split(jax.random.key(0), 3)), drives)
    assert found.shape == (3, 2000)
    assert np.median(found) < 0.06 and np.median(found[:, -1]) < 0.06 and np.all(found[:, -1] < 0.1)


@pytest.mark.slow
def test_forty_thousand_particles_find_the_robot(museum):  # within 126 updates, from anywhere
    drive = drive_below(museum, 2, distance=75.6, step=0.6)
    assert drive.brightness.shape == (126,)
    prior = Particles.uniform_planar(museum.origin, museum.upper, 40_000, key=jax.random.key(0))
    found = errors(follow(localizer(museum, 0.1, 0.08), drive, prior, jax.random.key(1)), drive)
    assert found[-1] < 0.5 and found[0] > 5.0
