"""Simulated concrete floor, a downward camera, and a drive around a loop with ground truth.

The floor *is* the bicubic interpolant of its texture, which is band-limited: where an image was taken is known to any
fraction of a pixel. Images average several rays a pixel, as a sensor does, through a lens and its vignetting.
"""

import cv2
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float32, Float64, UInt8

from jaxloc._jit import filter_jit
from jaxloc.images.interpolation import Bicubic, sample_components
from jaxloc.poses.planar import compose_poses, relative_poses
from jaxloc.sensors import BrownConrady, Pinhole
from jaxloc.sensors.ground_camera import GroundCamera

_OCTAVES = ((2, 0.55), (4, 0.7), (8, 0.8), (16, 0.8), (64, 0.9))  # texels from blob to blob, amplitude
_BLUR = 1.0  # of the finished texture, texels: leaves 1 % of the contrast at the highest frequency


class Floor(eqx.Module):
    """Top view of a floor.

    Args:
        texture: "rows columns", gray levels; columns run along x, rows along y.
        resolution: edge of a texel, m.
        origin: (x, y) of the center of texel (0, 0), m.
    """

    texture: Float32[np.ndarray, "rows columns"]
    resolution: float
    origin: tuple[float, float]


class FloorCamera(eqx.Module):
    """Downward camera with lens distortion, vignetting and noise.

    Args:
        ground: camera, lens and height; its road frame has x to the top of the image and y to its left.
        shape: rows and columns of an image.
        corner_loss: part of the light that the lens's rims take from the corners, beside the cosine's fourth power.
        black: gray level of darkness.
        noise: standard deviation of a gray level.
        samples: rays along an edge of a pixel.
    """

    ground: GroundCamera
    shape: tuple[int, int]
    corner_loss: float = 0.2
    black: float = 6.0
    noise: float = 1.5
    samples: int = 2

    def vignetting(self, u: Float32[np.ndarray, " n"], v: Float32[np.ndarray, " n"]) -> Float32[np.ndarray, " n"]:
        """Part of the light that arrives at pixels: ``cos^4 (1 - loss r^2)``, r = 1 in the corner."""
        x, y = self.ground.camera.normalize_components(jnp.asarray(u), jnp.asarray(v))
        middle = 0.5 * (np.array(self.shape[::-1], np.float32) - 1.0)
        radius = ((u - middle[0]) ** 2 + (v - middle[1]) ** 2) / np.float32(middle @ middle)
        return np.asarray(1.0 / (1.0 + x * x + y * y) ** 2) * (1.0 - np.float32(self.corner_loss) * radius)


class FloorDrive(eqx.Module):
    """Images of a floor with odometry and true poses.

    Attributes:
        floor: below.
        camera: of the images.
        frames: the images.
        poses: true poses (x, y, heading) of the camera's road frame on the floor, m and rad.
        odometry: measured motions (x, y, heading) from each image to the next.
        covariances: of the motions, in the tangent at their ends.
        gains: exposure of each image.
    """

    floor: Floor
    camera: FloorCamera
    frames: UInt8[np.ndarray, "n h w"]
    poses: Float64[np.ndarray, "n 3"]
    odometry: Float64[np.ndarray, "m 3"]
    covariances: Float64[np.ndarray, "m 3 3"]
    gains: Float64[np.ndarray, " n"]

    def reckoned(self) -> Float64[np.ndarray, "n 3"]:
        """Poses by odometry alone, from the true first one."""
        path = [self.poses[:1]]
        for motion in self.odometry:
            path.append(compose_poses(path[-1], motion[None]))
        return np.concatenate(path)


def make_floor(
    seed: int = 0,
    *,
    low: tuple[float, float] = (-0.4, -0.4),
    high: tuple[float, float] = (0.4, 0.4),
    resolution: float = 2e-4,
) -> Floor:
    """Concrete: octaves of smooth noise, specks of aggregate, cracks; band-limited.

    Args:
        seed: fixes it.
        low: least x and y, m.
        high: greatest x and y, m.
        resolution: edge of a texel, m.

    Returns:
        The floor, of mean 115 and standard deviation 22.

    Example:
        >>> from jaxloc.data.simulate.floor import make_floor
        >>> make_floor(low=(0.0, 0.0), high=(0.05, 0.04)).texture.shape
        (201, 251)
    """
    rng = np.random.default_rng(seed)
    columns, rows = (round((b - a) / resolution) + 1 for a, b in zip(low, high, strict=True))
    image = np.zeros((rows, columns), np.float32)
    for step, amplitude in _OCTAVES:
        grid = rng.standard_normal((rows // step + 8, columns // step + 8)).astype(np.float32)
        octave = cv2.resize(grid, None, fx=step, fy=step, interpolation=cv2.INTER_CUBIC)
        image += np.float32(amplitude) * octave[2 * step : 2 * step + rows, 2 * step : 2 * step + columns]
    _add_specks(image, rng)
    _add_cracks(image, rng)
    image = cv2.GaussianBlur(image, (0, 0), _BLUR)
    image = 115.0 + 22.0 * (image - image.mean()) / image.std()
    return Floor(np.clip(image, 10.0, 240.0).astype(np.float32), resolution, low)


def make_camera(
    shape: tuple[int, int] = (480, 640), *, focal: float | None = None, height: float = 0.14, k1: float = -0.3
) -> FloorCamera:
    """A camera over the floor, by default of 640 x 480 pixels of 0.2 mm.

    Args:
        shape: rows and columns.
        focal: length, px; by default 700 for 640 columns, and in proportion.
        height: over the floor, m.
        k1: first radial coefficient of the lens.

    Returns:
        The camera.

    Example:
        >>> from jaxloc.data.simulate.floor import make_camera
        >>> round(float(make_camera().ground.camera.fx))
        700
    """
    focal = 700.0 * shape[1] / 640.0 if focal is None else focal
    lens = BrownConrady((k1, 0.0, 0.0, 0.0))
    pinhole = Pinhole(focal, focal, 0.5 * (shape[1] - 1), 0.5 * (shape[0] - 1), lens=lens)
    return FloorCamera(GroundCamera(pinhole, height, pitch=0.5 * np.pi), shape)


class Photographer:
    """Renders images of a floor at given poses.

    Args:
        floor: below.
        camera: to take them with.
    """

    def __init__(self, floor: Floor, camera: FloorCamera):
        self.floor, self.camera = floor, camera
        self._texture = jnp.asarray(floor.texture)
        offsets = (np.arange(camera.samples, dtype=np.float32) + 0.5) / np.float32(camera.samples) - np.float32(0.5)
        u, v = np.meshgrid(*(np.arange(size, dtype=np.float32) for size in camera.shape[::-1]))
        self._shade = camera.vignetting(u.reshape(-1), v.reshape(-1)).reshape(camera.shape)
        rays = [(u.reshape(-1) + du, v.reshape(-1) + dv) for dv in offsets for du in offsets]
        self._points = [camera.ground.to_ground_components(jnp.asarray(a), jnp.asarray(b)) for a, b in rays]

    def take(
        self, pose: Float64[np.ndarray, "3"], *, gain: float = 1.0, rng: np.random.Generator | None = None
    ) -> UInt8[np.ndarray, "h w"]:
        """An image.

        Args:
            pose: (x, y, heading) of the camera's road frame on the floor.
            gain: exposure.
            rng: of the sensor's noise; none without it.

        Returns:
            Gray levels; beside the floor, those of darkness.
        """
        x, y, heading = pose
        x0, y0 = self.floor.origin
        start = jnp.asarray([(x - x0) / self.floor.resolution, (y - y0) / self.floor.resolution], jnp.float32)
        turn = jnp.asarray([np.cos(heading), np.sin(heading)], jnp.float32) / np.float32(self.floor.resolution)
        light = np.zeros(self.camera.shape, np.float32)
        for across, left in self._points:
            light += np.asarray(_look(self._texture, start, turn, across, left)).reshape(self.camera.shape)
        image = self.camera.black + gain * self._shade * light / len(self._points)
        if rng is not None:
            image = image + self.camera.noise * rng.standard_normal(image.shape, np.float32)
        return np.clip(np.rint(image), 0, 255).astype(np.uint8)


@filter_jit
def _look(
    texture: Float[Array, "rows columns"],
    start: Float[Array, "2"],
    turn: Float[Array, "2"],
    x: Float[Array, " n"],
    y: Float[Array, " n"],
) -> Float[Array, " n"]:
    """The floor at points of the camera's road frame."""
    u, v = start[0] + turn[0] * x - turn[1] * y, start[1] + turn[1] * x + turn[0] * y
    return sample_components(texture, u, v, method=Bicubic())[0]


def drive_loop(
    seed: int = 0,
    *,
    num_frames: int = 60,
    step: float = 0.025,
    camera: FloorCamera | None = None,
    floor: Floor | None = None,
    sigmas: tuple[float, float, float] = (4e-4, 3e-4, 4e-3),
) -> FloorDrive:
    """Simulates a drive once around a perturbed circle: the last image overlaps the first.

    Args:
        seed: fixes floor, path and all noise.
        num_frames: images round the loop.
        step: from one to the next, m.
        camera: that takes them; `make_camera()` by default.
        floor: below; by default made to fit the loop.
        sigmas: standard deviations of a measured motion: along, aside (m), heading (rad).

    Returns:
        The drive. The covariance of its odometry is the one that it was made with.

    Example:
        >>> from jaxloc.data.simulate.floor import drive_loop, make_camera
        >>> drive = drive_loop(num_frames=4, step=0.004, camera=make_camera((48, 64), height=0.014))
        >>> drive.frames.shape, drive.odometry.shape
        ((4, 48, 64), (3, 3))
    """
    rng = np.random.default_rng([seed, 1])
    camera = make_camera() if camera is None else camera
    radius = num_frames * step / (2.0 * np.pi)
    angle = 2.0 * np.pi * np.arange(num_frames) / num_frames
    wobble = 0.02 * np.sin(3.0 * angle + rng.uniform(0.0, 6.0))
    reach = radius * (1.0 + 0.06 * np.cos(2.0 * angle))
    poses = np.column_stack([reach * np.cos(angle), reach * np.sin(angle), angle + 0.5 * np.pi + wobble])
    if floor is None:
        edge = float(reach.max() + _view_radius(camera) + 0.002)
        resolution = float(camera.ground.height / camera.ground.camera.fx)
        floor = make_floor(seed, low=(-edge, -edge), high=(edge, edge), resolution=resolution)
    drift = np.cumsum(rng.normal(0.0, 0.03, num_frames))
    gains = np.exp(drift - drift.mean())
    photographer = Photographer(floor, camera)
    frames = [photographer.take(pose, gain=gain, rng=rng) for pose, gain in zip(poses, gains, strict=True)]
    noise = rng.standard_normal((num_frames - 1, 3)) * np.array(sigmas)
    odometry = compose_poses(relative_poses(poses[:-1], poses[1:]), noise)
    covariances = np.tile(np.diag(np.square(sigmas)), (num_frames - 1, 1, 1))
    return FloorDrive(floor, camera, np.stack(frames), poses, odometry, covariances, gains)


def _view_radius(camera: FloorCamera) -> float:
    """Distance of the corners of the field of view from the foot of the optical axis, m."""
    rows, columns = camera.shape
    u, v = jnp.array([-0.5, columns - 0.5]), jnp.array([-0.5, rows - 0.5])
    x, y = camera.ground.to_ground_components(u, v)
    return float(jnp.max(jnp.hypot(x, y)))


def _add_specks(image: Float32[np.ndarray, "rows columns"], rng: np.random.Generator) -> None:
    """Grains of aggregate: light and dark ellipses."""
    rows, columns = image.shape
    count = rows * columns // 900
    centers = rng.uniform((0, 0), (columns, rows), (count, 2))
    axes = np.maximum(rng.gamma(2.0, 1.2, (count, 2)), 0.8)
    turns, tones = rng.uniform(0.0, 180.0, count), rng.normal(0.0, 2.0, count)
    for center, axis, turn, tone in zip(centers, axes, turns, tones, strict=True):
        shape = (tuple(map(float, center)), tuple(map(float, 2.0 * axis)), float(turn))
        cv2.ellipse(image, shape, float(tone), -1)


def _add_cracks(image: Float32[np.ndarray, "rows columns"], rng: np.random.Generator) -> None:
    """Dark lines that wander."""
    rows, columns = image.shape
    for _ in range(max(1, rows * columns // 120_000)):
        place, heading = rng.uniform((0, 0), (columns, rows)), rng.uniform(-np.pi, np.pi)
        headings = heading + np.cumsum(rng.normal(0.0, 0.25, 60))
        ways = np.cumsum(6.0 * np.column_stack([np.cos(headings), np.sin(headings)]), axis=0)
        line = np.rint(8.0 * (place + ways)).astype(np.int32)[:, None]
        cv2.polylines(image, [line], False, float(rng.uniform(-4.0, -2.0)), 1, cv2.LINE_8, 3)
