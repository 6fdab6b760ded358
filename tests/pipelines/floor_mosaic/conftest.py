"""A drive over a synthetic floor, and its mosaic."""

import pytest

from jaxloc.data.simulate import floor
from jaxloc.pipelines import floor_mosaic

SHAPE, HEIGHT, FRAMES = (160, 208), 0.045, 24


@pytest.fixture(scope="session")
def drive():
    """A loop of small images with a distorting lens."""
    camera = floor.make_camera(SHAPE, height=HEIGHT)
    return floor.drive_loop(3, num_frames=FRAMES, step=0.008, camera=camera, sigmas=(1.5e-4, 1.5e-4, 4e-3))


@pytest.fixture(scope="session")
def built(drive):
    return floor_mosaic.make_mosaic(
        drive.frames, drive.odometry, drive.camera.ground, covariances=drive.covariances, initial=drive.poses[0]
    )
