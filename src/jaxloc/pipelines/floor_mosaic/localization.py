"""Localization of a camera in a finished floor mosaic, an image at a time."""

from collections.abc import Iterable, Iterator

import equinox as eqx
import numpy as np
from jaxtyping import Float64

from jaxloc.pipelines.floor_mosaic.mosaic import FloorMosaic, Frame
from jaxloc.pipelines.floor_mosaic.options import Config
from jaxloc.pipelines.floor_mosaic.registration import odometry_covariances, pose_of_row, row_of_pose
from jaxloc.pipelines.input_checks import check_image
from jaxloc.poses.planar import compose_poses
from jaxloc.slam.mosaic import FloorView, Patch, Rectifier, track


class Output(eqx.Module):
    """Pose of the camera in the mosaic at one image.

    Attributes:
        pose: (x, y, heading) in the frame of the mosaic; predicted by odometry where not ok.
        covariance: in its tangent.
        ok: whether the image was aligned with the mosaic.
        num_steps: of the alignment.
    """

    pose: Float64[np.ndarray, "3"]
    covariance: Float64[np.ndarray, "3 3"]
    ok: bool
    num_steps: int


class State(eqx.Module):
    """State of the localization between two images.

    Attributes:
        config: options.
        mosaic: the map.
        rectifier: maps the middle of the images to the floor.
        pose: (x, y, heading) at the last image.
        covariance: in its tangent.
        num_frames: number of images so far.
        shape: rows and columns of the images; (0, 0) before the first one.
    """

    config: Config
    mosaic: Patch
    rectifier: Rectifier
    pose: Float64[np.ndarray, "3"]
    covariance: Float64[np.ndarray, "3 3"]
    num_frames: int
    shape: tuple[int, int]


def init(config: Config, mosaic: Patch, view: FloorView, *, initial: Float64[np.ndarray, "3"]) -> State:
    """The state before the first image.

    Args:
        config: options.
        mosaic: the map.
        view: camera and raster of the images.
        initial: predicted pose at the first image, in the frame of the mosaic.
    """
    rectifier = tracking_rectifier(view, config)
    return State(config, mosaic, rectifier, np.asarray(initial, np.float64), np.zeros((3, 3)), 0, (0, 0))


def step(state: State, frame: Frame) -> tuple[State, Output]:
    """Aligns the next image with the mosaic.

    Args:
        state: from `init` or the last step.
        frame: image and odometry; the motion of the first image is not used.

    Returns:
        The next state, and the pose.

    Raises:
        ValueError: the image is no grayscale image of bytes or floats, or of another size than those before.
    """
    shape, config = check_image(frame.image, state.shape), state.config
    pose, covariance = state.pose, state.covariance
    if state.num_frames:
        motion = np.asarray(frame.motion, np.float64)
        pose = compose_poses(pose[None], motion[None])[0]
        noise = odometry_covariances(motion[None], config)[0] if frame.covariance is None else frame.covariance
        covariance = covariance + noise
    found = track(state.mosaic, frame.image, pose_of_row(pose), view=state.rectifier)
    ok = bool(found.ok)
    if ok:
        pose, covariance = row_of_pose(found.value), np.asarray(found.covariance, np.float64)
    after = State(config, state.mosaic, state.rectifier, pose, covariance, state.num_frames + 1, shape)
    return after, Output(pose, covariance, ok, int(found.num_steps))


def run(
    frames: Iterable[Frame], config: Config, built: FloorMosaic, *, initial: Float64[np.ndarray, "3"]
) -> Iterator[Output]:
    """Follows a camera on a later drive over a mosaic, see `step`.

    Args:
        frames: images and odometry.
        config: options.
        built: the mosaic.
        initial: predicted pose at the first image, in the frame of the mosaic.

    Yields:
        The pose at each image; where it was not aligned, the pose predicted by odometry from the last.
    """
    state = init(config, built.mosaic, built.view, initial=initial)
    for frame in frames:
        state, output = step(state, frame)
        yield output


def tracking_rectifier(view: FloorView, config: Config) -> Rectifier:
    """Rectifier of the middle of the images, which localization uses."""
    part = [length - 2 * round(0.5 * (1.0 - config.tracking) * length) for length in view.raster.shape]
    return view.part((part[0], part[1])).rectifier()
