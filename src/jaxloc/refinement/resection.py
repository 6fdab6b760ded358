"""The pose of a camera from what it sees of known points: refinement of a guess, and a start from nothing."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxloc.multiview import triangulation
from jaxloc.poses import SE3
from jaxloc.refinement.reprojection import Reprojection, StereoReprojection, stereo_jacobian, whitener
from jaxloc.sensors import Pinhole, StereoRig
from jaxloc.solvers import Estimate, GaussNewton, Quadratic, Solver, solve


@eqx.filter_jit
def refine_pose(
    camera: Pinhole,
    points_world: Float[Array, "n 3"],
    pixels: Float[Array, "n 2"],
    initial: SE3,
    *,
    loss: Any = Quadratic(),
    valid: Bool[Array, " n"] | None = None,
    sigma: Any = 1.0,
    solver: Solver = GaussNewton(),
) -> Estimate:
    """Pose of a camera from pixels of known points, starting at a guess (PnP refinement).

    Minimizes ``sum rho(|project(T^-1 X_i) - z_i|^2 / sigma^2)`` over the pose ``T = T_world_camera``.

    Args:
        camera: intrinsics and lens.
        points_world: "n 3", world frame, m.
        pixels: "n 2" (u right, v down), px.
        initial: guess of the camera's pose ``T_world_camera`` (camera to world; the inverse of OpenCV's rvec, tvec).
        loss: robust kernel, in sigmas.
        valid: which points count; numbers of others, nan too, have no influence.
        sigma: standard deviation of a pixel coordinate, px.
        solver: how to minimize.

    Returns:
        Estimate of ``T_world_camera`` with covariance in its tangent (right perturbation: camera axes). ``ok`` is False
        when fewer than three independent points are seen, when under plain least squares a point lies behind the
        camera, or when the solver did not converge.

    References:
        Lepetit and Fua, "Monocular model-based 3D tracking of rigid objects", 2005, section 2.4 [K-56, K-73].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> camera = jl.sensors.Pinhole(500.0, 500.0, 320.0, 240.0)
        >>> points = jnp.array([[0.0, 0.0, 5.0], [1.0, 0.0, 6.0], [0.0, 1.0, 7.0], [1.0, 1.0, 5.0]])
        >>> pixels = camera.project(points - jnp.array([[0.2, 0.0, 0.0]]))
        >>> fit = jl.refinement.resection.refine_pose(camera, points, pixels, jl.poses.SE3.identity())
        >>> bool(fit.ok), fit.value.translation.round(3).tolist()[0]
        (True, 0.20000000298023224)
    """
    usable, points, pixels = _usable(valid, points_world, pixels)
    sigma = jnp.asarray(sigma, pixels.dtype)
    problem = Reprojection(camera, points.T, pixels.T, sigma, usable, loss)
    return solve(problem, initial, solver=solver)


@eqx.filter_jit
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

    Points triangulated in the previous frame carry their covariance ``S0`` into the residual ``h(T^-1 X) - z``, whose
    covariance is ``S1 + J S0 J^T``: near points with good depth count for translation, far ones for rotation only.

    Args:
        rig: the stereo rig.
        previous: "n 3" (u_left, u_right, v) in the previous frame, px.
        current: "n 3" the same points in the current frame, px.
        initial: guess of ``T_previous_current``, the pose of the current left camera in the previous one.
        covariance_previous: of measurements in the previous frame, px^2, one for all or one a point; identity
            by default.
        covariance_current: of measurements in the current frame, likewise.
        loss: robust kernel over an item's three components, in sigmas.
        valid: which matches count.

    Returns:
        Estimate of ``T_previous_current`` with covariance in its tangent (axes of the current camera).

    References:
        Matthies and Shafer, "Error modeling in stereo navigation", 1987; thesis section 4.3 [K-86, K-87, T-72].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> rig = jl.sensors.StereoRig(jl.sensors.Pinhole(700.0, 700.0, 600.0, 180.0), baseline=0.5)
        >>> points = jnp.array([[0.0, 0.0, 9.0], [2.0, 1.0, 8.0], [-2.0, 1.0, 12.0], [1.0, -1.0, 7.0]])
        >>> forward = points - jnp.array([[0.0, 0.0, 1.0]])
        >>> start = jl.poses.SE3.identity()
        >>> fit = jl.refinement.resection.refine_motion(rig, rig.project(points), rig.project(forward), start)
        >>> bool(fit.ok), round(float(fit.value.translation[2]), 3)
        (True, 1.0)
    """
    matches = StereoMatches.of(previous, current, covariance_previous, covariance_current, valid)
    # The weights depend on the pose so little that those of a first fit serve for the second.
    first = solve(motion_problem(rig, matches, initial, loss), initial, max_steps=10)
    weights_at = jax.tree.map(jax.lax.stop_gradient, first.value)
    problem = motion_problem(rig, matches, weights_at, loss)
    return solve(problem, weights_at)


class StereoMatches(eqx.Module):
    """Points measured by a stereo rig in two frames.

    Attributes:
        previous: (u_left, u_right, v) in the previous frame, px.
        current: the same points in the current frame, px.
        covariance_previous: of the measurements in the previous frame, px^2.
        covariance_current: of those in the current frame.
        valid: slots that hold a match; others hold finite numbers without meaning.
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
        """Matches with what is not given filled in, and slots with bad numbers made invalid."""
        usable, previous, current = _usable(valid, previous, current)

        def noise(covariance: Any) -> Float[Array, "n 3 3"]:
            eye = jnp.eye(3, dtype=previous.dtype)
            full = jnp.broadcast_to(eye if covariance is None else covariance, (*previous.shape[:1], 3, 3))
            return jnp.where(usable[:, None, None], full, eye[None])

        return StereoMatches(previous, current, noise(covariance_previous), noise(covariance_current), usable)


def motion_problem(rig: StereoRig, matches: StereoMatches, pose: SE3, loss: Any) -> StereoReprojection:
    """The motion's problem, linearized in the measurements of the previous frame at a pose near the answer.

    Depth is so far from linear in disparity that weights taken at the noisy measurement favor points that noise has
    brought nearer. So the previous measurement is first moved to where both frames agree best, and the residual and its
    covariance are expanded there: the step from Sampson's error to maximum likelihood.

    Args:
        rig: the stereo rig.
        matches: measurements in two frames.
        pose: ``T_previous_current`` at which covariances are carried to the current frame.
        loss: robust kernel.

    Returns:
        A problem whose state is ``T_previous_current``.
    """
    usable = matches.valid & rig.has_depth(matches.previous)
    believed = matches.previous
    for _ in range(2):
        transfer, predicted = _transfer(rig, pose, believed, usable)
        shift = _product(transfer, (matches.previous - believed)[..., None])[..., 0]
        error = matches.current - predicted - shift
        total = matches.covariance_current + _product(transfer, _product(matches.covariance_previous, transfer.mT))
        whiten = whitener(total)
        believed = _agreeing_measurement(rig, matches, transfer, whiten, error, believed)
    transfer, _ = _transfer(rig, pose, believed, usable)
    shift = _product(transfer, (matches.previous - believed)[..., None])[..., 0]
    total = matches.covariance_current + _product(transfer, _product(matches.covariance_previous, transfer.mT))
    points = rig.triangulate(believed)
    return StereoReprojection(rig, points.T, (matches.current - shift).T, whitener(total), usable, loss)


def _transfer(
    rig: StereoRig, pose: SE3, believed: Array, usable: Array
) -> tuple[Float[Array, "n 3 3"], Float[Array, "n 3"]]:
    """Where points measured in the previous frame appear in the current one, and the derivative of that."""
    moved = pose.inverse().apply(rig.triangulate(believed))
    seen = usable & rig.in_front(moved)
    c = tuple(jnp.where(seen, moved[:, i], 0.0 if i < 2 else 1.0) for i in range(3))
    back = pose.rotation.matrix().T
    to_point = jax.vmap(lambda z: triangulation.stereo_jacobian(rig, z))(believed)
    by_point = jnp.transpose(stereo_jacobian(rig, c), (2, 1, 0))
    transfer = _product(by_point, _product(back[None], to_point))
    return jnp.where(seen[:, None, None], transfer, 0.0), rig.project_components(*c).T


def _agreeing_measurement(
    rig: StereoRig, matches: StereoMatches, transfer: Array, whiten: Array, error: Array, believed: Array
) -> Float[Array, "n 3"]:
    """The previous measurement moved to where both frames agree best; that of outliers stays."""
    w = jnp.moveaxis(whiten, -1, 0)
    whitened = _product(w, error[..., None])
    gain = _product(matches.covariance_previous, _product(w, transfer).mT)
    moved = matches.previous + _product(gain, whitened)[..., 0]
    plausible = jnp.sum(whitened[..., 0] ** 2, axis=1) < 25.0
    return jnp.where((plausible & rig.has_depth(moved))[:, None], moved, believed)


def _product(a: Array, b: Array) -> Array:
    return jnp.matmul(a, b, precision="highest")


def _usable(valid: Any, first: Array, second: Array) -> tuple[Bool[Array, " n"], Array, Array]:
    """The mask of finite items, and the items with the others replaced by zero: bad numbers stop here."""
    finite = jnp.all(jnp.isfinite(first), axis=1) & jnp.all(jnp.isfinite(second), axis=1)
    usable = finite if valid is None else valid & finite
    return usable, jnp.where(usable[:, None], first, 0.0), jnp.where(usable[:, None], second, 0.0)
