"""Camera tracking in a floor mosaic, image by image."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Num

from jaxloc._jit import filter_jit
from jaxloc.alignment.lucas_kanade import LucasKanade, Pyramid, align
from jaxloc.images.warps import Euclidean
from jaxloc.poses import SE2
from jaxloc.slam.mosaic.blend import corner_of_window
from jaxloc.slam.mosaic.raster import Raster
from jaxloc.slam.mosaic.register import in_meters
from jaxloc.slam.mosaic.view import FloorView, Patch, Rectifier
from jaxloc.solvers import Estimate

# A mosaic is the mean of several images: most of the noise is that of the one that is laid upon it.
TRACKING = LucasKanade(
    scales=Pyramid(levels=4, least=40), template_noise=1.5, min_coverage=0.4, max_steps=15, tolerance=5e-3
)


@filter_jit
def track(
    mosaic: Patch,
    image: Num[Array, "h w"] | Any,
    predicted: SE2,
    *,
    view: FloorView | Rectifier,
    method: LucasKanade = TRACKING,
    margin: int = 32,
) -> Estimate:
    """Estimates the pose of a camera over a floor from one image, a mosaic and a predicted pose.

    The image is rectified on the raster of the view and laid upon a window of the mosaic about the predicted pose
    (of a fixed size: one program serves all poses) by `lucas_kanade.align` on rotations and shifts.

    Args:
        mosaic: the map.
        image: gray levels, bytes or numbers.
        predicted: initial value of the pose ``T_floor_camera`` of the camera's road frame, right to `margin` pixels.
        view: camera and raster, of the mosaic's resolution; its `rectifier`, made once, is quicker. A smaller raster
            (`FloorView.part`) is quicker too.
        method: choices of the alignment.
        margin: how far beyond the patch the window reaches, px; static.

    Returns:
        Estimate of ``T_floor_camera`` with covariance in its tangent (m, m, rad), from the noise of the images.
        ``ok`` is False off the mosaic, on a blank or featureless image, or where image and mosaic do not agree; the
        value is finite in any case. It has the derivatives of the solution by mosaic, image and view.

    References:
        Floor-mosaic tracking [K-80]: "submillimeter precision and 60 mph speeds are possible".

    Example:
        >>> import jax, jax.numpy as jnp, jaxloc as jl
        >>> from jaxloc.slam.mosaic import FloorView, blend, enclose
        >>> from jaxloc.data.simulate import floor
        >>> drive = floor.drive_loop(num_frames=40, step=0.002, camera=floor.make_camera((120, 160), height=0.035))
        >>> rectifier = FloorView.of(drive.camera.ground, (120, 160), black=6.0).rectifier()
        >>> poses = jax.vmap(jl.poses.SE2)(*jnp.asarray(drive.poses[:3], jnp.float32).T)
        >>> mosaic = blend(rectifier.rectify_all(drive.frames[:3]), poses, enclose(poses, rectifier.raster))
        >>> truth = jl.poses.SE2(*drive.poses[3])
        >>> predicted = truth @ jl.poses.SE2(4e-4, -4e-4, 0.01)
        >>> found = track(mosaic, drive.frames[3], predicted, view=rectifier)
        >>> bool(found.ok), bool(jnp.linalg.norm(truth.local(found.value)[:2]) < 1e-4)
        (True, True)
    """
    dtype = mosaic.values.dtype
    patch = view.rectify(image)
    side = int(np.ceil(np.hypot(*patch.raster.shape))) + 2 * margin
    mosaic = _at_least(mosaic, side)
    rows, columns = corner_of_window(predicted, patch.raster, mosaic.raster, (side, side))
    window = lax.dynamic_slice(mosaic.with_gaps(), (rows, columns), (side, side))
    shift = jnp.stack([columns, rows]).astype(dtype)
    raster = Raster(mosaic.raster.origin + mosaic.raster.resolution * shift, mosaic.raster.resolution, (side, side))
    start = raster.warp(predicted, patch.raster)
    found = align(window, patch.with_gaps(), Euclidean, start, method=method, weights=patch.weight)
    return in_meters(found, raster, patch.raster)


def _at_least(mosaic: Patch, side: int) -> Patch:
    """The mosaic with empty margins, where it is smaller than a window."""
    more = [max(0, side - length) for length in mosaic.raster.shape]
    if not any(more):
        return mosaic
    width = ((0, more[0]), (0, more[1]))
    shape = (mosaic.raster.shape[0] + more[0], mosaic.raster.shape[1] + more[1])
    raster = Raster(mosaic.raster.origin, mosaic.raster.resolution, shape)
    return Patch(jnp.pad(mosaic.values, width), jnp.pad(mosaic.weight, width), raster)
