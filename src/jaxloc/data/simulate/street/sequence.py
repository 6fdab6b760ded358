"""Stereo images of a synthetic street, with true poses, depths and moving objects.

The images are rendered on demand (`rendering`), always the same ones for a seed.
"""

from collections.abc import Iterator

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float32, Float64, Int32

from jaxloc.data.simulate.street.rendering import Intrinsics, Rendering, render
from jaxloc.data.simulate.street.textures import TextureAtlas, make_street_textures
from jaxloc.data.simulate.street.world import CAMERA_HEIGHT, Street, make_street
from jaxloc.data.stereo_sequence import StereoFrame
from jaxloc.poses import Trajectory
from jaxloc.sensors import Pinhole, StereoRig

_FRAME_RATE = 10.0


class MovingObject(eqx.Module):
    """Ground truth of a moving box.

    Args:
        instance: its number in the instance images.
        size: width, height, length, m.
        poses: ``T_world_box`` of every frame; the origin is on the ground below the middle of the box, z forward.
    """

    instance: int
    size: tuple[float, float, float]
    poses: Float64[np.ndarray, "n 4 4"]


class StreetFrame(eqx.Module):
    """Rendered stereo pair with ground truth.

    Args:
        stereo: the images.
        depth: of the left image, along the optical axis, m; infinite in the sky.
        instances: which moving object each pixel of the left image shows; 0 is the background.
    """

    stereo: StereoFrame
    depth: Float32[np.ndarray, "h w"]
    instances: Int32[np.ndarray, "h w"]


class StreetSequence(eqx.Module):
    """A drive along a synthetic street. Made by :func:`simulate_street`.

    Args:
        name: for titles.
        rig: the cameras.
        times: s.
        truth: poses of the left camera; the first is the identity.
        objects: what moves.
        size: height and width of an image, px.
        street: the world.
        atlas: its textures.
        matrices: the true poses in double precision.
        noise: standard deviation of the noise of a pixel, gray values.
        exposure: standard deviation of the brightness factor of a frame.
        seed: fixes noise and exposure.
    """

    name: str
    rig: StereoRig
    times: Float64[np.ndarray, " n"]
    truth: Trajectory
    objects: tuple[MovingObject, ...]
    size: tuple[int, int]
    street: Street
    atlas: TextureAtlas
    matrices: Float64[np.ndarray, "n 4 4"]
    noise: float
    exposure: float
    seed: int

    def __len__(self) -> int:
        return len(self.times)

    def __getitem__(self, index: int) -> StereoFrame:
        return self.render(index).stereo

    def __iter__(self) -> Iterator[StereoFrame]:
        return (self[index] for index in range(len(self)))

    def render(self, index: int) -> StreetFrame:
        """Renders a frame with its truth.

        Args:
            index: the number of the frame.

        Returns:
            The frame.
        """
        index = range(len(self))[index]
        camera = self.rig.camera
        numbers = (float(value) for value in (camera.fx, camera.fy, camera.cx, camera.cy))
        intrinsics = Intrinsics(*numbers, *self.size)
        rectangles = self.street.rectangles(float(self.times[index]))
        left_from_world = np.linalg.inv(self.matrices[index])
        right_from_left = np.eye(4)
        right_from_left[0, 3] = -float(self.rig.baseline)
        left = render(rectangles, self.atlas, intrinsics, left_from_world)
        right = render(rectangles, self.atlas, intrinsics, right_from_left @ left_from_world)
        images = (self._expose(view, index, side) for side, view in enumerate((left, right)))
        return StreetFrame(StereoFrame(float(self.times[index]), *images), left.depth, left.instances)

    def _expose(self, view: Rendering, index: int, side: int) -> np.ndarray:
        gain = 1.0 + self.exposure * np.random.default_rng([self.seed, index]).standard_normal()
        rng = np.random.default_rng([self.seed, index, side + 1])
        noise = rng.standard_normal(view.image.shape, dtype=np.float32)
        image = np.float32(gain) * view.image + np.float32(self.noise) * noise
        return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def simulate_street(
    *,
    seed: int = 0,
    num_frames: int = 60,
    size: tuple[int, int] = (200, 640),
    rig: StereoRig | None = None,
    speed: float = 10.0,
    noise: float = 1.5,
    exposure: float = 0.0,
) -> StreetSequence:
    """Simulates a drive along a winding street with parked and moving boxes, at 10 frames a second.

    The vehicle pitches and rolls a little. The world frame is that of the first camera.

    Args:
        seed: fixes the street and the noise.
        num_frames: how many.
        size: height and width of an image, px.
        rig: the cameras; where not given, those of KITTI, scaled to the width of the image.
        speed: m/s.
        noise: standard deviation of the noise of a pixel, gray values.
        exposure: standard deviation of the brightness factor of a frame.

    Returns:
        The sequence; frames are rendered on demand.

    Raises:
        ValueError: when there is to be no frame, or no pixel.

    Example:
        >>> sequence = simulate_street(num_frames=2, size=(60, 200))
        >>> frame = sequence.render(1)
        >>> frame.stereo.left.shape, frame.depth.shape, len(sequence)
        ((60, 200), (60, 200), 2)
    """
    if num_frames < 1 or min(size) < 1:
        raise ValueError(f"num_frames={num_frames} and size={size} came; at least one of each is needed.")
    times = np.arange(num_frames) / _FRAME_RATE
    street = make_street(seed, length=float(times[-1]) * speed, speed=speed)
    matrices = np.stack([_camera_pose(street, time, speed) for time in times])
    objects = tuple(
        MovingObject(m.instance, m.size, np.stack([m.pose(street.road, time) for time in times])) for m in street.movers
    )
    return StreetSequence(
        name="street",
        rig=_scaled_kitti_rig(size) if rig is None else rig,
        times=times,
        truth=Trajectory.from_matrices(jnp.asarray(times), jnp.asarray(matrices)),
        objects=objects,
        size=size,
        street=street,
        atlas=make_street_textures(seed),
        matrices=matrices,
        noise=noise,
        exposure=exposure,
        seed=seed,
    )


def _scaled_kitti_rig(size: tuple[int, int]) -> StereoRig:
    height, width = size
    focal = 718.856 / 1241.0 * width
    return StereoRig(Pinhole(focal, focal, 0.489 * width, 0.49 * height), 0.54)


def _camera_pose(street: Street, time: float, speed: float) -> Float64[np.ndarray, "4 4"]:
    """``T_world_camera``: on the road, with some pitch and roll that begin at zero."""
    pose = street.road.pose(speed * float(time))
    pose[1, 3] -= CAMERA_HEIGHT
    pitch, roll = 0.004 * np.sin(2.0 * np.pi * 0.9 * time), 0.006 * np.sin(2.0 * np.pi * 0.6 * time)
    cp, sp, cr, sr = np.cos(pitch), np.sin(pitch), np.cos(roll), np.sin(roll)
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cp, -sp], [0.0, sp, cp]])
    about_z = np.array([[cr, -sr, 0.0], [sr, cr, 0.0], [0.0, 0.0, 1.0]])
    pose[:3, :3] = pose[:3, :3] @ about_x @ about_z
    return pose
