"""Mosaics of floors from images and odometry, and localization in them.

Each image is laid upon those before it; where the path comes back to a place, images are laid upon those taken
there earlier; a pose graph makes all of it agree; then the images are blended to one map.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float64

from jaxloc.pipelines.floor_mosaic.path import (
    Config,
    Pair,
    PathBuilder,
    odometry_covariances,
    planar,
    pose_of_row,
    row_of_pose,
)
from jaxloc.poses.planar import compose_poses
from jaxloc.sensors.ground_camera import GroundCamera
from jaxloc.slam.mosaic import FloorView, Patch, Raster, Rectifier, blend, enclose, fit_falloff, tracking

_FEWEST_TO_FIT = 10  # images whose mean is even enough to show the falloff of the light
_MOST_PIXELS = 200_000_000


class FloorMosaic(eqx.Module):
    """A mosaic and the path along which its images were taken.

    Attributes:
        mosaic: the map.
        view: camera and raster that it was made with.
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
        """Numbers of the images that overlap no other, or show nothing."""
        return tuple(int(number) for number in np.flatnonzero(~self.used))


class Tracked(eqx.Module):
    """Where a camera was found in a mosaic.

    Attributes:
        pose: (x, y, heading) in the frame of the mosaic; predicted where not found.
        covariance: in its tangent.
        ok: whether it was found.
        num_steps: of the alignment.
    """

    pose: Float64[np.ndarray, "3"]
    covariance: Float64[np.ndarray, "3 3"]
    ok: bool
    num_steps: int


def make_mosaic(
    frames: Sequence[np.ndarray] | np.ndarray,
    odometry: Float64[np.ndarray, "m 3"],
    ground: GroundCamera,
    *,
    covariances: Float64[np.ndarray, "m 3 3"] | None = None,
    start: Float64[np.ndarray, "3"] | None = None,
    config: Config | None = None,
) -> FloorMosaic:
    """Joins images of a floor to one map.

    Args:
        frames: gray images of one size, bytes or numbers (nan where a pixel is not to be used).
        odometry: measured motion (x, y, heading) from each image to the next, m and rad: x to the top of the image,
            y to its left.
        ground: camera with lens and height, looking down.
        covariances: of the motions, in their tangents; by `Config.odometry` if not given.
        start: pose of the first image; the origin by default.
        config: options.

    Returns:
        The mosaic. Images that overlap no other are left out, and named in `left_out`; their poses are those of the
        odometry.

    Raises:
        ValueError: there are fewer than two images, of different sizes, or another number of motions.

    References:
        [K-83, K-84, K-85]; Kelly, "Mobile robot localization from large-scale appearance mosaics", IJRR 2000.
    """
    config = Config() if config is None else config
    images, odometry = _checked(frames, odometry)
    view = make_view(images, ground, config)
    patches = view.rectifier().rectify_all(images)
    noise = odometry_covariances(odometry, config) if covariances is None else np.asarray(covariances, np.float64)
    begin = np.zeros(3) if start is None else np.asarray(start, np.float64)
    builder = PathBuilder(patches, odometry, noise, begin, config)
    builder.follow()
    before = builder.poses.copy()
    for _ in range(config.rounds):
        builder.close_loops()
        builder.settle()
    used = builder.connected()
    exposures = builder.exposures()
    poses = planar(builder.poses)
    kept = jax.tree.map(lambda leaf: leaf[np.flatnonzero(used)] if used.any() else leaf[:1], poses)
    raster = _affordable(enclose(kept, view.raster))
    mosaic = blend(patches, poses, raster, exposures=exposures, used=jnp.asarray(used))
    gains = np.asarray(exposures.gain, np.float64)
    pairs = tuple(builder.pairs)
    return FloorMosaic(mosaic, view, builder.poses, builder.covariances, used, before, pairs, gains, builder.ok)


def localize(
    built: FloorMosaic | tuple[Patch, FloorView],
    frames: Sequence[np.ndarray] | np.ndarray,
    odometry: Float64[np.ndarray, "m 3"],
    start: Float64[np.ndarray, "3"],
    *,
    config: Config | None = None,
) -> Iterator[Tracked]:
    """Follows a camera on a later drive, an image at a time.

    Args:
        built: the mosaic, or its map and view.
        frames: gray images.
        odometry: measured motion from each image to the next.
        start: predicted pose of the first, in the frame of the mosaic.
        config: options.

    Yields:
        The pose at each image; where it is not found, the pose predicted by odometry from the last.
    """
    config = Config() if config is None else config
    mosaic, view = (built.mosaic, built.view) if isinstance(built, FloorMosaic) else built
    rectifier = tracking_rectifier(view, config)
    pose, spread = np.asarray(start, np.float64), np.zeros((3, 3))
    noise = odometry_covariances(np.asarray(odometry, np.float64), config)
    for number, frame in enumerate(frames):
        if number:
            pose = compose_poses(pose[None], odometry[number - 1 : number])[0]
            spread = spread + noise[number - 1]
        found = tracking(mosaic, frame, pose_of_row(pose), view=rectifier)
        ok = bool(found.ok)
        if ok:
            pose, spread = row_of_pose(found.value), np.asarray(found.covariance, np.float64)
        yield Tracked(pose, spread, ok, int(found.num_steps))


def make_view(images: np.ndarray, ground: GroundCamera, config: Config) -> FloorView:
    """The view of whole images, with the falloff of the light measured from them if they are enough."""
    view = FloorView.of(ground, images.shape[1:], resolution=config.resolution or None, black=config.black)
    if len(images) < _FEWEST_TO_FIT:
        return view
    return eqx.tree_at(lambda v: v.falloff, view, fit_falloff(images, black=config.black))


def tracking_rectifier(view: FloorView, config: Config) -> Rectifier:
    """What tracking looks at: the middle of the images."""
    part = [length - 2 * round(0.5 * (1.0 - config.tracking) * length) for length in view.raster.shape]
    return view.part((part[0], part[1])).rectifier()


def _checked(frames: Any, odometry: Any) -> tuple[np.ndarray, np.ndarray]:
    shapes = {np.asarray(frame).shape for frame in frames}
    if len(frames) < 2 or len(shapes) > 1 or len(next(iter(shapes))) != 2:
        raise ValueError(f"make_mosaic: give two or more gray images of one size; got {len(frames)} of {shapes}.")
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
