"""The simulated building: rays against a march in small steps, clear paths, odometry that errs."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.data.simulate.laser import cast_rays, make_building, simulate_laser_drive
from jaxloc.poses.planar import relative_poses


def test_rays_end_where_a_march_ends(rng):
    boxes = make_building(2).boxes
    poses = np.array([[2.0, 5.3, 0.3], [8.0, 5.0, -2.0]])
    angles = rng.uniform(-np.pi, np.pi, 25)
    ranges = cast_rays(boxes, poses, angles, 7.0)
    steps = np.arange(0.0, 7.0, 0.002)
    for pose, row in zip(poses, ranges, strict=True):
        for angle, expected in zip(angles + pose[2], row, strict=True):
            x, y = pose[0] + steps * np.cos(angle), pose[1] + steps * np.sin(angle)
            hit = ((x[:, None] >= boxes[:, 0]) & (x[:, None] <= boxes[:, 2])) & (
                (y[:, None] >= boxes[:, 1]) & (y[:, None] <= boxes[:, 3])
            )
            inside = np.flatnonzero(hit.any(axis=1))
            assert expected == pytest.approx(steps[inside[0]] if inside.size else 7.0, abs=0.003)


@pytest.mark.parametrize("seed", range(4))
def test_the_robot_meets_no_wall(seed):
    drive = simulate_laser_drive(seed=seed, noise=0.0, clutter=0.0)
    assert drive.log.ranges.min() > 0.2
    free = np.asarray(drive.building.map().free)
    cells = np.asarray(drive.building.map().to_cells(jnp.asarray(drive.truth[:, :2], jnp.float32))).round().astype(int)
    assert free[cells[:, 1], cells[:, 0]].all()
    steps = relative_poses(drive.truth[:-1], drive.truth[1:])
    assert np.hypot(steps[:, 0], steps[:, 1]).max() < 0.26 and np.abs(steps[:, 2]).max() < 0.4


def test_odometry_drifts_and_seeds_repeat():
    drive, again = simulate_laser_drive(seed=1), simulate_laser_drive(seed=1)
    np.testing.assert_array_equal(drive.log.odometry, again.log.odometry)
    np.testing.assert_array_equal(drive.log.ranges, again.log.ranges)
    ends = relative_poses(drive.truth[:1], drive.truth[-1:])[0]
    assert np.hypot(*(drive.log.odometry[-1] - ends)[:2]) > 0.5
    with pytest.raises(ValueError, match="at least one"):
        make_building(num_rooms=0)
