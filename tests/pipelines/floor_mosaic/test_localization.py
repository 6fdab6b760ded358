"""Localization in a finished mosaic: errors against exact truth, a blank image, a restored run."""

import numpy as np
import pytest

from jaxloc.data.simulate import floor
from jaxloc.pipelines import floor_mosaic
from jaxloc.pipelines.floor_mosaic import Config, localization
from jaxloc.poses.planar import compose_poses, relative_poses

PIXEL = 0.045 / (700.0 * 208 / 640)  # m


@pytest.mark.slow
def test_localization_on_a_second_drive(drive, built, check_resumed):
    rng = np.random.default_rng(4)
    photographer = floor.Photographer(drive.floor, drive.camera)
    truth = compose_poses(drive.poses[:8], rng.normal(size=(8, 3)) * np.array([1e-3, 1e-3, 0.1]))
    frames = [photographer.take(pose, gain=1.1, rng=rng) for pose in truth]
    odometry = compose_poses(
        relative_poses(truth[:-1], truth[1:]), rng.normal(size=(7, 3)) * np.array([2e-4, 2e-4, 4e-3])
    )
    frames[4] = np.full_like(frames[4], 80)
    start = compose_poses(truth[:1], np.array([[5e-4, -5e-4, 0.01]]))[0]
    images = list(floor_mosaic.split_frames(np.stack(frames), odometry))
    found = list(localization.run(images, Config(), built, initial=start))
    check_resumed(
        lambda: localization.init(Config(), built.mosaic, built.view, initial=start), localization.step, images, 4
    )
    assert [out.ok for out in found] == [True] * 4 + [False] + [True] * 3
    errors = relative_poses(truth, np.stack([out.pose for out in found]))
    distance = np.hypot(errors[:, 0], errors[:, 1])
    assert distance[[0, 1, 2, 3, 5, 6, 7]].max() < 0.2 * PIXEL and distance[4] < 1e-3
    assert np.trace(found[4].covariance) > 10 * np.trace(found[3].covariance)
