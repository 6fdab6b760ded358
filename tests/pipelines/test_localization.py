"""Localization of whole logs: from anywhere, from a start, with bad scans, when carried away."""

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


def errors(steps, truth):
    difference = relative_poses(np.stack([step.pose for step in steps]), truth)
    return np.hypot(difference[:, 0], difference[:, 1])


@pytest.fixture(scope="module")
def steps(drive, grid):
    return list(localization.steps(part(drive.log, slice(0, 55)), grid, config=CONFIG))


def test_the_robot_is_found_and_followed_with_fewer_particles(drive, steps):
    assert [step.index for step in steps] == list(range(55))
    error = errors(steps, drive.truth[:55])
    found = np.array([step.found for step in steps])
    assert found[-1] and found.mean() > 0.5 and np.median(error[found]) < 0.05
    assert steps[0].num_particles == 10_000 and steps[-1].num_particles == 1000
    assert steps[0].cloud.shape == (600, 3)


def test_a_start_and_scans_between(drive, grid):
    start = SE2(*(float(value) for value in drive.truth[0]))
    config = dataclasses.replace(CONFIG, min_translation=0.6, min_rotation=0.6)
    steps = list(localization.steps(part(drive.log, slice(0, 40)), grid, start, config))
    updated = np.array([step.updated for step in steps])
    assert len(steps) == 40 and 0.2 < updated.mean() < 0.7
    assert max(errors(steps, drive.truth[:40])) < 0.3 and steps[0].num_particles == 1000


def test_bad_readings_are_masked(drive, grid):
    log = part(drive.log, slice(0, 40))
    ranges = log.ranges.copy()
    ranges[5] = np.nan
    ranges[6] = np.inf
    ranges[7] = -1.0
    ranges[8] = 0.0
    ranges[:, ::5] = np.nan
    log = eqx.tree_at(lambda record: record.ranges, log, ranges)
    steps = list(localization.steps(log, grid, SE2(*(float(value) for value in drive.truth[0])), CONFIG))
    assert np.isfinite([step.pose for step in steps]).all() and max(errors(steps, drive.truth[:40])) < 0.4


def test_a_lost_robot_gets_the_large_cloud_again(drive, grid):
    log = part(drive.log, np.r_[0:40, 150:210])
    odometry = log.odometry.copy()
    odometry[40:] += odometry[39] - odometry[40]  # the log does not show that it was carried
    log = eqx.tree_at(lambda record: record.odometry, log, odometry)
    steps = list(localization.steps(log, grid, SE2(*(float(value) for value in drive.truth[0])), CONFIG))
    sizes = np.array([step.num_particles for step in steps])
    assert (sizes[:40] == 1000).all() and (sizes[40:] == 10_000).any()


def test_scans_are_selected_by_motion():
    odometry = np.zeros((50, 3))
    odometry[:, 0] = 0.03 * np.arange(50)
    odometry[20:, 2] = np.pi - 0.05
    odometry[30:, 2] = -np.pi + 0.05  # a tenth of a radian further
    chosen = localization.select_scans(odometry, 0.1, 0.15)
    assert chosen[0] == 0 and 20 in chosen and np.diff(chosen).max() <= 4
    assert len(localization.select_scans(np.zeros((9, 3)), 0.1, 0.1)) == 1


def test_maps_that_cannot_serve(drive):
    empty = OccupancyMap(jnp.zeros((5, 5)), 0.1, SE2.identity())
    with pytest.raises(ValueError, match="no obstacle"):
        list(localization.steps(drive.log, empty))
    full = OccupancyMap(jnp.ones((5, 5)), 0.1, SE2.identity())
    with pytest.raises(ValueError, match="no free cell"):
        list(localization.steps(drive.log, full))
    with pytest.raises(ValueError, match="num_particles is 0"):
        Config(num_particles=0)
