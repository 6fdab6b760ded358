"""Mosaics of floors from images and odometry.

Each image is registered with those before it, frame by frame; `finish` closes loops, solves the pose graph, and blends
the images to one map.
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float64

from jaxloc.pipelines.floor_mosaic.options import Config
from jaxloc.pipelines.floor_mosaic.registration import (
    Pair,
    Path,
    close_loops,
    estimate_exposures,
    extend,
    find_connected,
    odometry_covariances,
    optimize_poses,
    planar,
)
from jaxloc.pipelines.input_checks import check_image
from jaxloc.sensors.ground_camera import GroundCamera
from jaxloc.slam.mosaic import FloorView, Overlap, Patch, Raster, Rectifier, blend, enclose, fit_falloff

_FEWEST_TO_FIT = 10  # images whose mean is uniform enough to show the falloff of the light
_MOST_PIXELS = 200_000_000


class FloorMosaic(eqx.Module):
    """A mosaic and the path along which its images were taken.

    Attributes:
        mosaic: the map.
        view: camera and raster of the images.
        poses: (x, y, heading) of each image, m and rad.
        covariances: of the poses, in their tangents.
        used: which images are in the mosaic.
        before_closure: poses by neighbors alone.
        pairs: all registrations that were tried.
        gains: exposure of each image.
        ok: whether the pose graph was solved.
    """

    mosaic: Patch
    view: FloorView
    poses: Float64[np.ndarray, "n 3"]
    covariances: Float64[np.ndarray, "n 3 3"]
    used: Bool[np.ndarray, " n"]
    before_closure: Float64[np.ndarray, "n 3"]
    pairs: tuple[Pair, ...]
    gains: Float64[np.ndarray, " n"]
    ok: bool

    @property
    def left_out(self) -> tuple[int, ...]:
        """Numbers of the images that could not be registered."""
        return tuple(int(number) for number in np.flatnonzero(~self.used))


class Frame(eqx.Module):
    """An image of the floor with the odometry since the last one.

    Attributes:
        image: gray levels, bytes or floating-point numbers; non-finite pixels are ignored.
        motion: (x, y, heading) from the last image to this one, m and rad: x to the top of the image, y to its left;
            not used of the first image.
        covariance: of the motion, in its tangent; by `Config.odometry` if not given.
    """

    image: np.ndarray
    motion: Float64[np.ndarray, "3"]
    covariance: Float64[np.ndarray, "3 3"] | None = None


class Output(eqx.Module):
    """Pose of one image by those before it.

    Attributes:
        index: number of the image, from 0.
        pose: (x, y, heading), m and rad.
        ok: whether the image was registered with one before it; otherwise the pose is that of the odometry.
    """

    index: int
    pose: Float64[np.ndarray, "3"]
    ok: bool


class State(eqx.Module):
    """State of the mosaic between two images.

    Attributes:
        config: options.
        view: camera and raster of the images.
        rectifier: maps images to the floor.
        initial: pose of the first image.
        path: images, registrations and poses so far.
        shape: rows and columns of the images; (0, 0) before the first one.
    """

    config: Config
    view: FloorView
    rectifier: Rectifier
    initial: Float64[np.ndarray, "3"]
    path: Path
    shape: tuple[int, int]

    def sizes(self) -> dict[str, int]:
        """Number of images and registrations, for checkpoints."""
        return {"images": len(self.path), "pairs": len(self.path.pairs)}

    def resized(self, sizes: dict[str, int]) -> "State":
        """A state with so many images and registrations of no meaning, for checkpoints."""
        none = jnp.zeros((0, 0), self.rectifier.u.dtype)
        patches = (Patch(none, none, self.rectifier.raster),) * sizes["images"]
        two, zero = jnp.zeros(2, none.dtype), jnp.zeros((), none.dtype)
        pair = Pair(0, 0, np.zeros(3), np.zeros((3, 3)), 0.0, False, False, Overlap(zero, two, two))
        pairs = (pair,) * sizes["pairs"]
        return eqx.tree_at(lambda s: (s.path.patches, s.path.pairs), self, (patches, pairs))


def init(config: Config, view: FloorView, *, initial: Float64[np.ndarray, "3"] | None = None) -> State:
    """The state before the first image.

    Args:
        config: options.
        view: camera and raster of the images, see `make_view`.
        initial: pose (x, y, heading) of the first image; the origin by default.
    """
    first = np.zeros(3) if initial is None else np.asarray(initial, np.float64)
    return State(config, view, view.rectifier(), first, Path.start(), (0, 0))


def step(state: State, frame: Frame) -> tuple[State, Output]:
    """Registers the next image with those before it.

    Args:
        state: from `init` or the last step.
        frame: image and odometry.

    Returns:
        The next state, and the pose of the image.

    Raises:
        ValueError: the image is no grayscale image of bytes or floats, or of another size than those before, or the
            odometry has non-finite values.
    """
    shape = check_image(frame.image, state.shape)
    config, path, number = state.config, state.path, len(state.path)
    motion = np.asarray(frame.motion, np.float64) if number else state.initial
    if not np.isfinite(motion).all():
        raise ValueError(f"The odometry of image {number} has non-finite values.")
    noise = odometry_covariances(motion[None], config)[0] if frame.covariance is None else frame.covariance
    path = extend(path, state.rectifier.rectify(frame.image), motion, np.asarray(noise, np.float64), config)
    ok = any(pair.ok and pair.second == number for pair in path.pairs)
    output = Output(number, path.poses[number], ok)
    return State(config, state.view, state.rectifier, state.initial, path, shape), output


def finish(state: State) -> FloorMosaic:
    """Closes loops, solves the pose graph, and blends the images.

    Args:
        state: after two or more images.

    Returns:
        The mosaic. Images that overlap no other are left out, and named in `left_out`; their poses are those of the
        odometry.

    Raises:
        ValueError: there are fewer than two images, or the mosaic is too large.

    References:
        [K-83, K-84, K-85]; Kelly, "Mobile robot localization from large-scale appearance mosaics", IJRR 2000.
    """
    config, view = state.config, state.view
    if len(state.path) < 2:
        raise ValueError(f"A mosaic needs two or more images; got {len(state.path)}.")
    path = optimize_poses(state.path, config)
    before = path.poses.copy()
    for _ in range(config.rounds):
        path = optimize_poses(close_loops(path, config), config)
    used, exposures, poses = find_connected(path), estimate_exposures(path), planar(path.poses)
    kept = jax.tree.map(lambda leaf: leaf[np.flatnonzero(used)] if used.any() else leaf[:1], poses)
    raster = _affordable(enclose(kept, view.raster))
    values, weight = (jnp.stack([getattr(p, name) for p in path.patches]) for name in ("values", "weight"))
    patches = Patch(values, weight, path.patches[0].raster)
    mosaic = blend(patches, poses, raster, exposures=exposures, used=jnp.asarray(used))
    gains = np.asarray(exposures.gain, np.float64)
    return FloorMosaic(mosaic, view, path.poses, path.covariances, used, before, path.pairs, gains, path.ok)


def run(
    frames: Iterable[Frame], config: Config, view: FloorView, *, initial: Float64[np.ndarray, "3"] | None = None
) -> Iterator[Output]:
    """Poses along a recording, see `step`; `make_mosaic` gives the map.

    Args:
        frames: images and odometry.
        config: options.
        view: camera and raster of the images.
        initial: pose of the first image; the origin by default.

    Yields:
        The pose of each image by those before it.
    """
    state = init(config, view, initial=initial)
    for frame in frames:
        state, output = step(state, frame)
        yield output


def make_mosaic(
    images: Sequence[np.ndarray] | np.ndarray,
    odometry: Float64[np.ndarray, "m 3"],
    ground: GroundCamera,
    *,
    covariances: Float64[np.ndarray, "m 3 3"] | None = None,
    initial: Float64[np.ndarray, "3"] | None = None,
    config: Config | None = None,
) -> FloorMosaic:
    """Makes a mosaic of a recording: `init`, `step` for each image, `finish`.

    Args:
        images: grayscale images of one size, bytes or floating-point numbers (nan where a pixel is not to be used).
        odometry: measured motion (x, y, heading) from each image to the next, m and rad: x to the top of the image,
            y to its left.
        ground: camera with lens and height, looking down.
        covariances: of the motions, in their tangents; by `Config.odometry` if not given.
        initial: pose of the first image; the origin by default.
        config: options.

    Returns:
        The mosaic, see `finish`.

    Raises:
        ValueError: there are fewer than two images, of different sizes, or another number of motions.
    """
    config = Config() if config is None else config
    stacked, odometry = _checked(images, odometry)
    state = init(config, make_view(stacked, ground, config), initial=initial)
    for frame in split_frames(stacked, odometry, covariances=covariances, config=config):
        state, _ = step(state, frame)
    return finish(state)


def split_frames(
    images: np.ndarray,
    odometry: Float64[np.ndarray, "m 3"],
    *,
    covariances: Float64[np.ndarray, "m 3 3"] | None = None,
    config: Config = Config(),
) -> Iterator[Frame]:
    """The frames of a recording held in arrays, see `make_mosaic`."""
    noise = odometry_covariances(odometry, config) if covariances is None else np.asarray(covariances, np.float64)
    for number, image in enumerate(images):
        if not number:
            yield Frame(image, np.zeros(3), np.zeros((3, 3)))
        else:
            yield Frame(image, odometry[number - 1], noise[number - 1])


def make_view(images: np.ndarray, ground: GroundCamera, config: Config) -> FloorView:
    """Camera and raster of images, with the falloff of the light measured from them if there are at least ten."""
    view = FloorView.of(ground, images.shape[1:], resolution=config.resolution or None, black=config.black)
    if len(images) < _FEWEST_TO_FIT:
        return view
    return eqx.tree_at(lambda v: v.falloff, view, fit_falloff(images, black=config.black))


def _checked(frames: Any, odometry: Any) -> tuple[np.ndarray, np.ndarray]:
    shapes = {np.asarray(frame).shape for frame in frames}
    if len(frames) < 2 or len(shapes) > 1 or len(next(iter(shapes))) != 2:
        raise ValueError(f"make_mosaic: give two or more grayscale images of one size; got {len(frames)} of {shapes}.")
    odometry = np.asarray(odometry, np.float64)
    if odometry.shape != (len(frames) - 1, 3):
        raise ValueError(
            f"make_mosaic: {len(frames)} images need {len(frames) - 1} motions (x, y, heading) between them; "
            f"got an array of shape {odometry.shape}."
        )
    if not np.isfinite(odometry).all():
        raise ValueError("make_mosaic: the odometry has numbers that are not finite.")
    return np.stack([np.asarray(frame) for frame in frames]), odometry


def _affordable(raster: Raster) -> Raster:
    rows, columns = raster.shape
    if rows * columns > _MOST_PIXELS:
        raise ValueError(
            f"make_mosaic: the mosaic would have {rows} x {columns} pixels; is the odometry in m? "
            "A coarser Config.resolution makes it smaller."
        )
    return raster
