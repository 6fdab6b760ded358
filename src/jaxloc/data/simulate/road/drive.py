"""Simulated drive along a road: images with the true lane position of the vehicle."""

from collections.abc import Iterator

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float32, Float64

from jaxloc.data.simulate.road.geometry import RoadGeometry, SmallAngles
from jaxloc.data.simulate.road.rendering import Road, render
from jaxloc.lanes.lane import Lane
from jaxloc.sensors.ground_camera import GroundCamera


class Course(eqx.Module):
    """Parameters of a drive: sinusoids about a mean, so that truth and motion agree exactly.

    Args:
        speed: m/s.
        interval: between two images, s.
        curvature: amplitude, 1/m,
        bend: and wavelength along the road, m.
        sway: amplitude of the offset, m,
        period: and its period, s.
        offset: mean, m.
        pitch: amplitude of the pitching, rad,
        pitch_period: and its period, s.
    """

    speed: float = 20.0
    interval: float = 0.05
    curvature: float = 1e-3
    bend: float = 900.0
    sway: float = 0.4
    period: float = 9.0
    offset: float = 0.1
    pitch: float = 0.004
    pitch_period: float = 0.9


class RoadDrive(eqx.Module):
    """Drive with ground truth; images are rendered on demand.

    Attributes:
        road: appearance of the road.
        ground: the camera with its mean pitch.
        times: s.
        travelled: way along the road, m.
        lanes: offset (m), heading (rad), curvature (1/m) and its rate (1/m^2) at each image.
        pitches: of the camera at each image, rad.
        speeds: m/s.
        yaw_rates: counter-clockwise, rad/s.
        shape: rows and columns of an image.
        geometry: of the road.
    """

    road: Road
    ground: GroundCamera
    times: Float64[np.ndarray, " t"]
    travelled: Float64[np.ndarray, " t"]
    lanes: Float64[np.ndarray, "t 4"]
    pitches: Float64[np.ndarray, " t"]
    speeds: Float64[np.ndarray, " t"]
    yaw_rates: Float64[np.ndarray, " t"]
    shape: tuple[int, int] = (480, 640)
    geometry: RoadGeometry = SmallAngles()

    def __len__(self) -> int:
        return len(self.times)

    def lane(self, index: int) -> Lane:
        """The true lane at an image."""
        return Lane(*(float(value) for value in self.lanes[index]))

    def camera(self, index: int) -> GroundCamera:
        """The camera with its true pitch at an image."""
        pitch = jnp.asarray(self.pitches[index], self.ground.height.dtype)
        return eqx.tree_at(lambda ground: ground.pitch, self.ground, pitch)

    def frame(self, index: int) -> Float32[np.ndarray, "h w"]:
        """An image."""
        return render(
            self.road,
            self.lane(index),
            self.camera(index),
            shape=self.shape,
            travelled=float(self.travelled[index]),
            seed=self.road.seed + 1000 + index,
            geometry=self.geometry,
        )

    def frames(self) -> Iterator[Float32[np.ndarray, "h w"]]:
        """All images, one after the other."""
        return (self.frame(index) for index in range(len(self)))


def drive(
    road: Road,
    ground: GroundCamera,
    num_frames: int,
    *,
    course: Course = Course(),
    shape: tuple[int, int] = (480, 640),
    start: float = 0.0,
    geometry: RoadGeometry = SmallAngles(),
) -> RoadDrive:
    """Drives along a road: ``offset' = v sin(heading)``, ``yaw rate = heading' + v curvature`` (cosines taken as one).

    Args:
        road: appearance of the road.
        ground: the camera with its mean pitch.
        num_frames: images.
        course: how the drive goes.
        shape: rows and columns of an image.
        start: way along the road at the first image, m.
        geometry: of the road.

    Returns:
        The drive.

    Example:
        >>> import jaxloc as jl
        >>> from jaxloc.data.simulate.road.rendering import Road
        >>> from jaxloc.data.simulate.road.drive import drive
        >>> ground = jl.sensors.GroundCamera(jl.sensors.Pinhole(60.0, 60.0, 39.5, 29.5), height=1.3, pitch=0.05)
        >>> trip = drive(Road(), ground, 3, shape=(60, 80))
        >>> len(list(trip.frames())), trip.travelled.tolist()
        (3, [0.0, 1.0, 2.0])
    """
    times = course.interval * np.arange(num_frames, dtype=np.float64)
    travelled = start + course.speed * times
    turn, wave = 2.0 * np.pi / course.period, 2.0 * np.pi / course.bend
    curvature = course.curvature * np.sin(wave * travelled)
    rate = course.curvature * wave * np.cos(wave * travelled)
    offset = course.offset + course.sway * np.sin(turn * times)
    slope = course.sway * turn * np.cos(turn * times) / course.speed
    heading = np.arcsin(slope)
    swing = -course.sway * turn**2 * np.sin(turn * times) / course.speed / np.sqrt(1.0 - slope**2)
    pitches = float(ground.pitch) + course.pitch * np.sin(2.0 * np.pi * times / course.pitch_period)
    speeds = np.full(num_frames, float(course.speed))
    yaw_rates = swing + course.speed * curvature
    lanes = np.column_stack([offset, heading, curvature, rate])
    return RoadDrive(road, ground, times, travelled, lanes, pitches, speeds, yaw_rates, shape, geometry)
