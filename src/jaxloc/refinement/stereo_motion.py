"""Motion of a stereo rig between two frames from matched stereo measurements, with errors in both frames."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxloc import _tree as tree
from jaxloc._arguments import checked
from jaxloc._jit import filter_jit
from jaxloc._linalg import matmul
from jaxloc.multiview import stereo_triangulation
from jaxloc.poses import SE3
from jaxloc.refinement.pnp import _usable
from jaxloc.refinement.reprojection import StereoReprojection, stereo_jacobian, whitener
from jaxloc.sensors import StereoRig
from jaxloc.solvers import Estimate, Quadratic, solve
from jaxloc.solvers.estimate import guarded


@filter_jit
@checked
def refine_motion(
    rig: StereoRig,
    previous: Float[Array, "n 3"],
    current: Float[Array, "n 3"],
    initial: SE3,
    *,
    covariance_previous: Float[Array, "3 3"] | Float[Array, "n 3 3"] | None = None,
    covariance_current: Float[Array, "3 3"] | Float[Array, "n 3 3"] | None = None,
    loss: Any = Quadratic(),
    valid: Bool[Array, " n"] | None = None,
) -> Estimate:
    """Motion of a stereo rig from matched measurements in two frames (errors in variables).

    The covariance ``S0`` of points triangulated in the previous frame enters the residual ``h(T^-1 X) - z``, whose
    covariance is ``S1 + J S0 J^T``: near points with good depth count for translation, far ones for rotation only.

    Args:
        rig: the stereo rig.
        previous: "n 3" (u_left, u_right, v) in the previous frame, px.
        current: "n 3" the same points in the current frame, px.
        initial: ``T_previous_current``, the pose of the current left camera in the previous one.
        covariance_previous: of measurements in the previous frame, px^2, one for all or one a point; identity
            by default.
        covariance_current: of measurements in the current frame, likewise.
        loss: robust kernel over an item's three components, in sigmas.
        valid: matches that are used.

    Returns:
        Estimate of ``T_previous_current`` with covariance in its tangent (axes of the current camera).

    References:
        Matthies and Shafer, "Error modeling in stereo navigation", 1987; thesis section 4.3 [K-86, K-87, T-72].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> rig = jl.sensors.StereoRig(jl.sensors.Pinhole(700.0, 700.0, 600.0, 180.0), baseline=0.5)
        >>> points = jnp.array([[0.0, 0.0, 9.0], [2.0, 1.0, 8.0], [-2.0, 1.0, 12.0], [1.0, -1.0, 7.0]])
        >>> forward = points - jnp.array([[0.0, 0.0, 1.0]])
        >>> initial = jl.poses.SE3.identity()
        >>> fit = jl.refinement.stereo_motion.refine_motion(rig, rig.project(points), rig.project(forward), initial)
        >>> bool(fit.ok), round(float(fit.value.translation[2]), 3)
        (True, 1.0)
    """
    matches = StereoMatches.of(previous, current, covariance_previous, covariance_current, valid)
    return guarded(tree.within_range(initial), _refine, rig, matches, initial, loss)


def _refine(rig: StereoRig, matches: "StereoMatches", initial: SE3, loss: Any) -> Estimate:
    # The weights depend little on the pose: those of a first fit are used in the second.
    first = solve(motion_problem(rig, matches, initial, loss), initial, max_steps=10)
    weights_at = jax.tree.map(jax.lax.stop_gradient, first.value)
    problem = motion_problem(rig, matches, weights_at, loss)
    return solve(problem, weights_at)


def _in_range(covariance: Array) -> Bool[Array, "*n"]:
    """Which covariances are finite, and have standard deviations in range; without derivatives."""
    greatest = tree.largest(covariance.dtype) ** 2
    return jnp.all(jnp.abs(jax.lax.stop_gradient(covariance)) < greatest, axis=(-2, -1))


class StereoMatches(eqx.Module):
    """Points measured by a stereo rig in two frames.

    Attributes:
        previous: (u_left, u_right, v) in the previous frame, px.
        current: the same points in the current frame, px.
        covariance_previous: of the measurements in the previous frame, px^2.
        covariance_current: of those in the current frame.
        valid: slots that hold a match; others hold arbitrary finite numbers.
    """

    previous: Float[Array, "n 3"]
    current: Float[Array, "n 3"]
    covariance_previous: Float[Array, "n 3 3"]
    covariance_current: Float[Array, "n 3 3"]
    valid: Bool[Array, " n"]

    @staticmethod
    def of(
        previous: Array, current: Array, covariance_previous: Any, covariance_current: Any, valid: Any
    ) -> "StereoMatches":
        """Matches with default covariances and mask; slots with non-finite values are invalid."""
        usable, previous, current = _usable(valid, previous, current)
        for covariance in (covariance_previous, covariance_current):
            usable = usable if covariance is None else usable & _in_range(covariance)

        def noise(covariance: Any) -> Float[Array, "n 3 3"]:
            eye = jnp.eye(3, dtype=previous.dtype)
            full = jnp.broadcast_to(eye if covariance is None else covariance, (*previous.shape[:1], 3, 3))
            return jnp.where(usable[:, None, None], full, eye[None])

        return StereoMatches(previous, current, noise(covariance_previous), noise(covariance_current), usable)


@checked
def motion_problem(rig: StereoRig, matches: StereoMatches, pose: SE3, loss: Any) -> StereoReprojection:
    """Least-squares problem of the motion, linearized in the previous measurements at a pose near the solution.

    Depth is so nonlinear in disparity that weights at the noisy measurement favor points that noise has moved nearer.
    So the previous measurement is first corrected to the most likely one given both frames, and the residual and its
    covariance are expanded there: the step from Sampson's error to maximum likelihood.

    Args:
        rig: the stereo rig.
        matches: measurements in two frames.
        pose: ``T_previous_current`` at which covariances are propagated to the current frame.
        loss: robust kernel.

    Returns:
        A problem whose state is ``T_previous_current``.
    """
    usable = matches.valid & rig.has_depth(matches.previous)
    corrected = matches.previous
    for _ in range(2):
        transfer, predicted = _transfer(rig, pose, corrected, usable)
        shift = matmul(transfer, (matches.previous - corrected)[..., None])[..., 0]
        error = matches.current - predicted - shift
        total = matches.covariance_current + matmul(transfer, matmul(matches.covariance_previous, transfer.mT))
        whiten = whitener(total)
        corrected = _correct_measurement(rig, matches, transfer, whiten, error, corrected)
    transfer, _ = _transfer(rig, pose, corrected, usable)
    shift = matmul(transfer, (matches.previous - corrected)[..., None])[..., 0]
    total = matches.covariance_current + matmul(transfer, matmul(matches.covariance_previous, transfer.mT))
    points = rig.triangulate(corrected)
    return StereoReprojection(rig, points.T, (matches.current - shift).T, whitener(total), usable, loss)


def _transfer(
    rig: StereoRig, pose: SE3, corrected: Array, usable: Array
) -> tuple[Float[Array, "n 3 3"], Float[Array, "n 3"]]:
    """Predicted measurements in the current frame of points measured in the previous one, and their derivative."""
    moved = pose.inverse().apply(rig.triangulate(corrected))
    visible = usable & rig.in_front(moved)
    c = tuple(jnp.where(visible, moved[:, i], 0.0 if i < 2 else 1.0) for i in range(3))
    back = pose.rotation.matrix().T
    to_point = jax.vmap(lambda z: stereo_triangulation.stereo_jacobian(rig, z))(corrected)
    by_point = jnp.transpose(stereo_jacobian(rig, c), (2, 1, 0))
    transfer = matmul(by_point, matmul(back[None], to_point))
    return jnp.where(visible[:, None, None], transfer, 0.0), rig.project_components(*c).T


def _correct_measurement(
    rig: StereoRig, matches: StereoMatches, transfer: Array, whiten: Array, error: Array, corrected: Array
) -> Float[Array, "n 3"]:
    """The most likely previous measurement given both frames; that of outliers is unchanged."""
    w = jnp.moveaxis(whiten, -1, 0)
    whitened = matmul(w, error[..., None])
    gain = matmul(matches.covariance_previous, matmul(w, transfer).mT)
    moved = matches.previous + matmul(gain, whitened)[..., 0]
    plausible = jnp.sum(whitened[..., 0] ** 2, axis=1) < 25.0
    return jnp.where((plausible & rig.has_depth(moved))[:, None], moved, corrected)
