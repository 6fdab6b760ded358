"""Localization of logs: global, from an initial pose, with bad scans, of a kidnapped robot."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.data import simulate_laser_drive
from jaxloc.pipelines import localization
from jaxloc.pipelines.localization import Config
from jaxloc.poses import SE2
from jaxloc.poses.planar import relative_poses
from jaxloc.sensors import OccupancyMap

CONFIG = Config(num_particles=1000, num_particles_global=10_000)


@pytest.fixture(scope="module")
def drive():
    return simulate_laser_drive(seed=3)


@pytest.fixture(scope="module")
def grid(drive):
    return drive.building.map()


def part(log, indices):
    fields = ("times", "ranges", "odometry")
    chosen = [getattr(log, name)[indices] for name in fields]
    return eqx.tree_at(lambda record: [getattr(record, name) for name in fields], log, chosen)


def errors(outs, truth):
    difference = relative_poses(np.stack([out.pose for out in outs]), truth)
    return np.hypot(difference[:, 0], difference[:, 1])


@pytest.fixture(scope="module")
def outs(drive, grid):
    return list(localization.run(part(drive.log, slice(0, 55)), CONFIG, grid))


def test_the_robot_is_found_and_followed_with_fewer_particles(drive, outs):
    assert [out.index for out in outs] == list(range(55))
    error = errors(outs, drive.truth[:55])
    found = np.array([out.found for out in outs])
    assert found[-1] and found.mean() > 0.5 and np.median(error[found]) < 0.05
    assert outs[0].num_particles == 10_000 and outs[-1].num_particles == 1000
    assert outs[0].cloud.shape == (600, 3)


def test_an_initial_pose_and_scans_that_are_not_used(drive, grid):
    initial = SE2(*(float(value) for value in drive.truth[0]))
    config = dataclasses.replace(CONFIG, min_translation=0.6, min_rotation=0.6)
    outs = list(localization.run(part(drive.log, slice(0, 40)), config, grid, initial=initial))
    updated = np.array([out.updated for out in outs])
    assert len(outs) == 40 and 0.2 < updated.mean() < 0.7
    assert max(errors(outs, drive.truth[:40])) < 0.3 and outs[0].num_particles == 1000


def test_bad_readings_are_masked(drive, grid):
    log = part(drive.log, slice(0, 40))
    ranges = log.ranges.copy()
    ranges[5] = np.nan
    ranges[6] = np.inf
    ranges[7] = -1.0
    ranges[8] = 0.0
    ranges[:, ::5] = np.nan
    log = eqx.tree_at(lambda record: record.ranges, log, ranges)
    outs = list(localization.run(log, CONFIG, grid, initial=SE2(*(float(value) for value in drive.truth[0]))))
    assert np.isfinite([out.pose for out in outs]).all() and max(errors(outs, drive.truth[:40])) < 0.4


def test_a_kidnapped_robot_gets_many_particles_again(drive, grid):
    log = part(drive.log, np.r_[0:40, 150:210])
    odometry = log.odometry.copy()
    odometry[40:] += odometry[39] - odometry[40]  # the log does not show that it was carried
    log = eqx.tree_at(lambda record: record.odometry, log, odometry)
    outs = list(localization.run(log, CONFIG, grid, initial=SE2(*(float(value) for value in drive.truth[0]))))
    sizes = np.array([out.num_particles for out in outs])
    assert (sizes[:40] == 1000).all() and (sizes[40:] == 10_000).any()


def test_scans_are_selected_by_motion(drive, grid):
    """Of a turn across pi only the difference counts."""
    odometry = np.zeros((10, 3))
    odometry[:, 0] = 0.03 * np.arange(10)
    odometry[5:, 2] = np.pi - 0.05
    odometry[7:, 2] = -np.pi + 0.05
    log = eqx.tree_at(lambda record: record.odometry, part(drive.log, slice(0, 10)), odometry)
    config = dataclasses.replace(CONFIG, num_particles=100, min_translation=0.1, min_rotation=0.15)
    updated = [out.updated for out in localization.run(log, config, grid, initial=SE2.identity())]
    assert np.flatnonzero(updated).tolist() == [0, 4, 5, 9]


@pytest.mark.slow
def test_a_restored_run_gives_the_same_numbers(drive, grid, check_resumed):
    """Across a change of the number of particles, and between scans that are not used."""
    config = dataclasses.replace(CONFIG, num_particles=300, num_particles_global=600, min_translation=0.3, chunk=3)
    frames = list(localization.scans(part(drive.log, slice(0, 24))))
    outs, _ = check_resumed(lambda: localization.init(config, grid, drive.log), localization.step, frames, 15)
    assert not outs[14].updated or not outs[15].updated
    assert {out.num_particles for out in outs} == {300, 600}


def test_scans_that_cannot_be_used_are_refused(drive, grid):
    state = localization.init(dataclasses.replace(CONFIG, num_particles_global=100), grid, drive.log)
    with pytest.raises(ValueError, match="give a vector"):
        localization.step(state, localization.Scan(0.0, np.zeros((2, 5), np.float32), np.zeros(3)))
    with pytest.raises(ValueError, match="give finite numbers"):
        localization.step(state, localization.Scan(0.0, np.zeros(5, np.float32), np.full(3, np.nan)))


def test_maps_that_cannot_be_used(drive):
    empty = OccupancyMap(jnp.zeros((5, 5)), 0.1, SE2.identity())
    with pytest.raises(ValueError, match="no obstacle"):
        list(localization.run(drive.log, CONFIG, empty))
    full = OccupancyMap(jnp.ones((5, 5)), 0.1, SE2.identity())
    with pytest.raises(ValueError, match="no free cell"):
        list(localization.run(drive.log, CONFIG, full))
    with pytest.raises(ValueError, match="num_particles is 0"):
        Config(num_particles=0)
