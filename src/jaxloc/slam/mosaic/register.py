"""Direct registration of two floor images: relative pose from gray levels."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxloc import _linalg
from jaxloc._jit import filter_jit
from jaxloc._linalg import matmul
from jaxloc.alignment.lucas_kanade import LucasKanade, Pyramid, align
from jaxloc.images.interpolation import AbstractInterpolation, Bilinear, sample_components
from jaxloc.images.warps import Euclidean
from jaxloc.poses import SE2
from jaxloc.slam.mosaic.raster import Raster
from jaxloc.slam.mosaic.view import Patch
from jaxloc.solvers import Estimate

_INTERPOLATION = 0.005  # px

PAIRWISE = LucasKanade(scales=Pyramid(levels=4, least=40), min_coverage=0.2, max_steps=20)


class Overlap(eqx.Module):
    """Gray-level statistics of the overlap of two patches; one pair, or a stack.

    Attributes:
        share: part of the second patch that lies on the first.
        means: gray level of the first and of the second there.
        deviations: their standard deviations there.
    """

    share: Float[Array, "*n"]
    means: Float[Array, "*n 2"]
    deviations: Float[Array, "*n 2"]


class Registration(eqx.Module):
    """Relative pose of two images, with its overlap statistics.

    Attributes:
        estimate: of ``T_first_second``, m and rad.
        overlap: of the two.
    """

    estimate: Estimate
    overlap: Overlap


@filter_jit
def register(first: Patch, second: Patch, predicted: SE2, *, method: LucasKanade = PAIRWISE) -> Registration:
    """Estimates the pose of one camera over a floor in the frame of another by image alignment.

    Minimizes ``sum_x w(x) (first(T x) - gain second(x) - bias)^2`` over ``T = T_first_second`` by `lucas_kanade.align`
    on rotations and shifts, from coarse to fine; exposure is eliminated.

    Args:
        first: the piece of floor that is the reference.
        second: the piece that is laid upon it; of the same resolution.
        predicted: initial value of ``T_first_second``, right to a tenth of the overlap.
        method: choices of the alignment.

    Returns:
        The motion with its covariance in its tangent (m, m, rad): noise of both images. ``ok`` is False without
        overlap or texture, or where the images do not agree.

    References:
        Sequential mosaicking with known range and an odometry prior [K-83]; the compound-left Jacobian of K-85 is what
        the alignment's steps come to, summed over pixels.

    Example:
        >>> import jax, jax.numpy as jnp, jaxloc as jl
        >>> from jaxloc.data.simulate import floor
        >>> drive = floor.drive_loop(num_frames=40, step=0.002, camera=floor.make_camera((120, 160), height=0.035))
        >>> view = jl.slam.mosaic.FloorView.of(drive.camera.ground, (120, 160), black=6.0)
        >>> first, second = (view.rectify(frame) for frame in drive.frames[:2])
        >>> found = register(first, second, jl.poses.SE2(0.0021, 0.0, 0.15))
        >>> bool(found.estimate.ok), round(float(found.overlap.share), 1)
        (True, 0.9)
    """
    estimate = align(
        first.with_gaps(),
        second.with_gaps(),
        Euclidean,
        first.raster.warp(predicted, second.raster),
        method=method,
        weights=second.weight,
    )
    pose = in_meters(estimate, first.raster, second.raster)
    return Registration(pose, compare(first, second, pose.value))


def in_meters(estimate: Estimate, outer: Raster, inner: Raster) -> Estimate:
    """Converts the estimate of a pixel warp to that of the pose between two rasters.

    Interpolation leaves errors of some thousandths of a pixel whatever the noise; their variance is added.
    """
    forth = inner.tangent_to_meters()
    back = _linalg.inverse(forth)
    shift = _INTERPOLATION * inner.resolution
    turn = jnp.full_like(shift, _INTERPOLATION / (0.5 * min(inner.shape)))
    covariance = matmul(forth, matmul(estimate.covariance, forth.T)) + jnp.diag(jnp.stack([shift, shift, turn]) ** 2)
    information = matmul(back.T, matmul(estimate.information, back))
    pose = outer.pose(estimate.value, inner)
    return Estimate(pose, covariance, estimate.cost, estimate.ok, estimate.num_steps, estimate.status, information)


def compare(
    first: Patch, second: Patch, T_first_second: SE2, *, method: AbstractInterpolation = Bilinear(), stride: int = 2
) -> Overlap:
    """Brightness and contrast of two patches in their overlap, on every `stride`-th pixel in each direction."""
    rows, columns = second.raster.shape
    dtype = second.values.dtype
    v, u = jnp.meshgrid(
        jnp.arange(0, rows, stride, dtype=dtype), jnp.arange(0, columns, stride, dtype=dtype), indexing="ij"
    )
    right, down = first.raster.warp(T_first_second, second.raster).map_components(u.reshape(-1), v.reshape(-1))
    values, inside = sample_components(first.values, right, down, method=method)
    weight, _ = sample_components(first.weight, right, down, method=method)
    other, known = (second.values[::stride, ::stride].reshape(-1), second.weight[::stride, ::stride].reshape(-1))
    both = jnp.where(inside, jnp.minimum(weight, known), 0.0)
    total = jnp.sum(both)
    safe = jnp.where(total > 0, total, 1.0)
    pair = jnp.stack([values, other])
    means = jnp.sum(both[None] * pair, axis=1) / safe
    variance = jnp.sum(both[None] * (pair - means[:, None]) ** 2, axis=1) / safe
    positive = variance > 0
    deviations = jnp.where(positive, jnp.sqrt(jnp.where(positive, variance, 1.0)), 0.0)
    share = jnp.mean((both > 0).astype(dtype)) / jnp.maximum(jnp.mean((known > 0).astype(dtype)), 1e-6)
    return jax.lax.stop_gradient(Overlap(share, means, deviations))
