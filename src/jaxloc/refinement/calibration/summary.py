"""Summary of a calibration: parameters with standard deviations, and reprojection errors."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxloc._arguments import checked
from jaxloc._jit import filter_jit
from jaxloc.poses import SE3
from jaxloc.refinement.calibration.problem import project
from jaxloc.refinement.calibration.zhang import finite_views
from jaxloc.sensors import KannalaBrandt, Pinhole
from jaxloc.solvers import Estimate

_BROWN_CONRADY = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")


class Parameters(eqx.Module):
    """Parameters of a camera with their covariance.

    Attributes:
        names: ``fx``, ``fy``, ``cx``, ``cy``, ``skew``, and the coefficients of the lens.
        values: px, and plain numbers for the lens.
        covariance: zero for fixed parameters.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    values: Float[Array, " p"]
    covariance: Float[Array, "p p"]

    def sigmas(self) -> Float[Array, " p"]:
        """Standard deviations."""
        variance = jnp.diagonal(self.covariance)
        return jnp.where(variance > 0, jnp.sqrt(jnp.where(variance > 0, variance, 1.0)), 0.0)


class Errors(eqx.Module):
    """Reprojection errors of a calibration.

    Attributes:
        errors: predicted minus measured corners, px; zero where masked.
        valid: corners that are used.
        board_rms: root mean square of the distance, of each image, px; zero for unused images.
        rms: of all.
    """

    errors: Float[Array, "boards corners 2"]
    valid: Bool[Array, "boards corners"]
    board_rms: Float[Array, " boards"]
    rms: Float[Array, ""]


@checked
def camera_names(camera: Pinhole) -> tuple[str, ...]:
    """Names of the components of a camera's tangent.

    Example:
        >>> camera_names(Pinhole(1.0, 1.0, 0.0, 0.0))
        ('fx', 'fy', 'cx', 'cy', 'skew')
    """
    lens = camera.lens
    size = 0 if lens is None else lens.coefficients.shape[0]  # pyright: ignore[reportAttributeAccessIssue]
    names = ("k1", "k2", "k3", "k4") if isinstance(lens, KannalaBrandt) else _BROWN_CONRADY
    return ("fx", "fy", "cx", "cy", "skew", *names[:size])


@checked
def camera_parameters(estimate: Estimate, which: int = 0) -> Parameters:
    """The parameters of a camera of a calibration.

    Args:
        estimate: of `calibrate` or `calibrate_stereo`.
        which: 0 for the (left) camera, 1 for the right one.

    Returns:
        Names, values and covariance.
    """
    value = estimate.value
    cameras = (value.camera,) if hasattr(value, "camera") else (value.left, value.right)
    names = [camera_names(camera) for camera in cameras]
    first = sum(len(some) for some in names[:which])
    chosen = slice(first, first + len(names[which]))
    values = jnp.concatenate([jnp.atleast_1d(leaf) for leaf in jax.tree.leaves(cameras[which])])
    return Parameters(names[which], values, estimate.covariance[chosen, chosen])


@filter_jit
@checked
def board_errors(
    camera: Pinhole,
    T_camera_board: SE3,
    board: Float[Array, "corners 3"],
    corners: Float[Array, "boards corners 2"],
    *,
    valid: Bool[Array, "boards corners"] | None = None,
) -> Errors:
    """Reprojection errors of boards, and their root mean squares (of the distance, as in OpenCV).

    Args:
        camera: the camera.
        T_camera_board: a pose for each image.
        board: corners in the frame of the board, m.
        corners: their measured pixels.
        valid: corners that are used.

    Returns:
        Errors.
    """
    views = finite_views(board, corners, valid)
    shown, _ = jax.vmap(lambda pose: project(camera, pose, views.board))(T_camera_board)
    errors = jnp.where(views.valid[:, None, :], shown - views.pixels, 0.0)
    squared = jnp.sum(errors**2, axis=1)
    count = jnp.sum(views.valid, axis=1).astype(squared.dtype)
    board_rms = jnp.sqrt(jnp.sum(squared, axis=1) / jnp.maximum(count, 1.0))
    rms = jnp.sqrt(jnp.sum(squared) / jnp.maximum(jnp.sum(count), 1.0))
    return Errors(jnp.swapaxes(errors, 1, 2), views.valid, board_rms, rms)
