"""Simulated floors: the texture's band, exact poses of the images, odometry with its covariance."""

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from jaxloc.data.simulate import floor
from jaxloc.poses.planar import relative_poses


@pytest.fixture(scope="module")
def drive():
    camera = floor.make_camera((48, 64), height=0.014)
    return floor.drive_loop(1, num_frames=30, step=0.004, camera=camera)


def test_the_texture_is_band_limited_and_seeded():
    made = floor.make_floor(2, low=(0.0, 0.0), high=(0.05, 0.05))
    np.testing.assert_array_equal(made.texture, floor.make_floor(2, low=(0.0, 0.0), high=(0.05, 0.05)).texture)
    assert np.abs(made.texture - floor.make_floor(3, low=(0.0, 0.0), high=(0.05, 0.05)).texture).mean() > 5.0
    centered = (made.texture - made.texture.mean()) * np.hanning(251)[:, None] * np.hanning(251)
    power = np.abs(np.fft.fftshift(np.fft.fft2(centered))) ** 2
    v, u = np.indices(power.shape) - 125
    assert power[np.hypot(u, v) > 100].sum() < 1e-3 * power.sum()
    assert 15.0 < made.texture.std() < 25.0 and made.texture.min() >= 10.0


def test_a_picture_shows_the_texture_where_the_lens_says(drive):
    """Against SciPy's cubic splines at points that a fixed-point undistortion gives."""
    camera = drive.camera
    quiet = floor.FloorCamera(camera.ground, camera.shape, corner_loss=0.0, black=0.0, samples=1)
    picture = floor.Photographer(drive.floor, quiet).take(drive.poses[4])
    v, u = np.indices(camera.shape).astype(float)
    xd, yd = (u - 31.5) / 70.0, (v - 23.5) / 70.0
    x, y = xd, yd
    for _ in range(60):
        gain = 1.0 - 0.3 * (x * x + y * y)
        x, y = xd / gain, yd / gain
    forward, left = -0.014 * y, -0.014 * x
    px, py, heading = drive.poses[4]
    at_x = px + np.cos(heading) * forward - np.sin(heading) * left
    at_y = py + np.sin(heading) * forward + np.cos(heading) * left
    origin, resolution = np.array(drive.floor.origin), drive.floor.resolution
    places = [(at_y - origin[1]) / resolution, (at_x - origin[0]) / resolution]
    expected = map_coordinates(drive.floor.texture, places, order=3) / (1.0 + x * x + y * y) ** 2
    assert np.abs(picture - expected).max() < 3.0 and np.abs(picture - expected).mean() < 0.5


def test_vignetting_and_exposure(drive):
    camera = drive.camera
    middle, corner = camera.vignetting(np.float32([31.5, 0.0]), np.float32([23.5, 0.0]))
    assert middle == pytest.approx(1.0, abs=1e-5) and 0.25 < corner < 0.6
    photographer = floor.Photographer(drive.floor, camera)
    bright, dark = (photographer.take(drive.poses[0], gain=gain).astype(float) for gain in (1.0, 0.5))
    np.testing.assert_allclose(dark - camera.black, 0.5 * (bright - camera.black), atol=0.8)
    noisy = photographer.take(drive.poses[0], rng=np.random.default_rng(0)).astype(float)
    assert np.std(noisy - bright) == pytest.approx(np.hypot(camera.noise, 0.4), rel=0.1)


def test_the_loop_closes_and_odometry_errs_as_stated(drive):
    assert drive.frames.shape == (30, 48, 64) and drive.frames.dtype == np.uint8
    steps = np.linalg.norm(np.diff(drive.poses[:, :2], axis=0), axis=1)
    gap = np.linalg.norm(drive.poses[-1, :2] - drive.poses[0, :2])
    assert gap < 1.3 * steps.max() and (drive.frames > 0).all()
    errors = relative_poses(relative_poses(drive.poses[:-1], drive.poses[1:]), drive.odometry)
    squared = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(drive.covariances), errors)
    assert 1.8 < squared.mean() < 4.6
    reckoned = drive.reckoned()
    np.testing.assert_allclose(relative_poses(reckoned[:-1], reckoned[1:]), drive.odometry, atol=1e-12)
