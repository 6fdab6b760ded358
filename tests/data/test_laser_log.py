"""The place of a laser on its robot, from all scans."""

import numpy as np
import pytest

from jaxloc.data.laser_log import Mounting, find_mounting
from jaxloc.poses.planar import compose_poses


@pytest.fixture
def drive(rng):
    headings = np.cumsum(rng.uniform(-0.2, 0.2, 80))
    steps = 0.2 * np.column_stack([np.cos(headings), np.sin(headings)])
    turned = np.arctan2(np.sin(headings), np.cos(headings))
    return np.column_stack([np.cumsum(steps, axis=0), turned])


def carried(drive, mount):
    lasers = compose_poses(drive, np.broadcast_to(np.array(mount, float), drive.shape))
    lasers[:, 2] = np.arctan2(np.sin(lasers[:, 2]), np.cos(lasers[:, 2]))
    return lasers.round(6)


@pytest.mark.parametrize("heading", [0.0, 1.57, -1.57, 3.1, np.pi, -np.pi, np.pi + 1e-6])
def test_any_heading_of_the_mount(drive, heading):
    found = find_mounting(drive.round(6), carried(drive, (-0.2, 0.1, heading)))
    assert found.kind == Mounting.RIGID and "mounted at (-0.2, 0.1)" in found.describe()
    np.testing.assert_allclose(found.pose[:2], [-0.2, 0.1], atol=1e-5)
    assert abs((found.pose[2] - heading + np.pi) % (2 * np.pi) - np.pi) < 1e-5


@pytest.mark.parametrize("constant", [0.0, 1.5])
def test_a_laser_whose_pose_was_never_set(drive, constant):
    found = find_mounting(drive, np.full_like(drive, constant))
    assert found.kind == Mounting.UNSET and found.pose == (0.0, 0.0, 0.0) and "never sets" in found.describe()


def test_scans_without_a_pose_do_not_count(drive):
    found = find_mounting(drive + 5.0, carried(drive + 5.0, (0.3, 0.0, np.pi)) * (np.arange(80) > 9)[:, None])
    assert found.kind == Mounting.RIGID and found.pose[0] == pytest.approx(0.3, abs=1e-5)


def test_corrected_poses(drive, rng):
    lasers = drive + np.cumsum(rng.normal(0.0, 0.05, drive.shape), axis=0)
    assert find_mounting(drive, lasers).kind == Mounting.CORRECTED


def test_a_robot_that_stands_still(drive):
    still = np.tile(drive[:1], (5, 1))
    assert find_mounting(still, carried(still, (0.1, 0.0, 0.0))).kind == Mounting.RIGID
    assert find_mounting(still, 0.0 * still).kind == Mounting.UNSET
    assert find_mounting(0.0 * still, 0.0 * still).kind == Mounting.RIGID
