"""Reprojection residuals of known points in a camera or a stereo rig.

Points lie along the last axis, components along the first, for speed.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxloc._arguments import checked
from jaxloc._jit import filter_jit
from jaxloc._linalg import matmul
from jaxloc.poses import SE3
from jaxloc.sensors import Pinhole, StereoRig
from jaxloc.solvers import Linearization, Problem, Quadratic
from jaxloc.solvers.problem import is_quadratic

# Residual of an invisible point, sigmas: large, so that no step moves points behind the camera.
_HIDDEN = 1e3


class Reprojection(Problem):
    """Least-squares problem of pixels of known points in one camera; the state is its pose ``T_world_camera``.

    With a center, the state is the pose of a frame with the camera's axes at this point instead. It turns about the
    points then, and not about the far camera: turning and moving sideways no longer look nearly the same, which single
    precision could not tell apart.

    Attributes:
        camera: the camera.
        points: "3 n", world frame, m; finite everywhere.
        pixels: "2 n" (u, v), px; finite everywhere.
        sigma: standard deviation of a pixel coordinate, px.
        valid: items that are used.
        loss: robust kernel over the two components of an item.
        center: point of the camera frame, m, at which the frame of the state lies; None for the camera itself.
    """

    camera: Pinhole
    points: Float[Array, "3 n"]
    pixels: Float[Array, "2 n"]
    sigma: Float[Array, ""]
    valid: Bool[Array, " n"]
    loss: Any = Quadratic()
    center: Float[Array, "3"] | None = None

    def residual(self, state: SE3) -> Float[Array, "2 n"]:
        """Whitened pixel errors, zero for masked items [K-56]."""
        c, visible = _camera_points(self.camera, state, self.points, self.valid, self.center)
        predicted = jnp.stack(self.camera.project_components(*c))
        return _mask(predicted - self.pixels, visible, self.valid, 1.0 / self.sigma)

    def linearize(self, state: SE3) -> Linearization:
        """Residual and its Jacobian in closed form."""
        c, visible = _camera_points(self.camera, state, self.points, self.valid, self.center)
        predicted = jnp.stack(self.camera.project_components(*c))
        # Weight and mask are applied to the smallest arrays.
        weight = jnp.where(visible, 1.0 / self.sigma, 0.0)
        jacobian = _pose_jacobian(_pixel_jacobian(self.camera, c, weight), self._levers(c))
        return Linearization(_mask(predicted - self.pixels, visible, self.valid, 1.0 / self.sigma), jacobian)

    def admissible(self, state: SE3) -> Bool[Array, ""]:
        """Whether three points are in front of the camera and, under plain least squares, all valid points."""
        return _enough_visible(self.camera, state, self.points, self.valid, self.loss, self.center)

    def hessian(self, state: SE3) -> Float[Array, "6 6"]:
        """Exact Hessian at a minimum."""
        c, visible = _camera_points(self.camera, state, self.points, self.valid, self.center)

        def item_cost(*c: Array) -> Array:
            error = (jnp.stack(self.camera.project_components(*c)) - self.pixels) / self.sigma
            return jnp.where(visible, self.loss.rho(jnp.sum(error**2, axis=0)), 0.0)

        return _rigid_hessian(item_cost, c, self._levers(c))

    def _levers(self, c: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        """The points in the frame of the state, about whose origin it turns."""
        if self.center is None:
            return c
        return c[0] - self.center[0], c[1] - self.center[1], c[2] - self.center[2]


class StereoReprojection(Problem):
    """Least-squares problem of stereo measurements of uncertain points; the state is the left ``T_world_camera``.

    Attributes:
        rig: the stereo rig.
        points: "3 n", world frame, m; finite everywhere.
        measured: "3 n" (u_left, u_right, v), px; finite everywhere.
        whitener: "3 3 n", lower triangular ``W`` with ``W S W^T = I`` for the covariance S of an item's residual.
        valid: items that are used.
        loss: robust kernel over the three components of an item.
    """

    rig: StereoRig
    points: Float[Array, "3 n"]
    measured: Float[Array, "3 n"]
    whitener: Float[Array, "3 3 n"]
    valid: Bool[Array, " n"]
    loss: Any = Quadratic()

    def residual(self, state: SE3) -> Float[Array, "3 n"]:
        """Whitened measurement errors, zero for masked items."""
        c, visible = _camera_points(self.rig.camera, state, self.points, self.valid)
        return self._whitened_error(c, visible)

    def _whitened_error(self, c: tuple[Array, Array, Array], visible: Bool[Array, " n"]) -> Float[Array, "3 n"]:
        error = self.rig.project_components(*c) - self.measured
        return _mask(_lower_product(self.whitener, error), visible, self.valid, 1.0)

    def linearize(self, state: SE3) -> Linearization:
        """Residual and its Jacobian in closed form."""
        c, visible = _camera_points(self.rig.camera, state, self.points, self.valid)
        jacobian = _pose_jacobian(stereo_jacobian(self.rig, c), c)
        jacobian = jax.vmap(lambda column: _lower_product(self.whitener, column))(jacobian)
        return Linearization(self._whitened_error(c, visible), jnp.where(visible[None, None, :], jacobian, 0.0))

    def admissible(self, state: SE3) -> Bool[Array, ""]:
        """Whether three points are in front of the camera and, under plain least squares, all valid points."""
        return _enough_visible(self.rig.camera, state, self.points, self.valid, self.loss)

    def hessian(self, state: SE3) -> Float[Array, "6 6"]:
        """Exact Hessian at a minimum."""
        c, visible = _camera_points(self.rig.camera, state, self.points, self.valid)

        def item_cost(*c: Array) -> Array:
            error = _lower_product(self.whitener, self.rig.project_components(*c) - self.measured)
            return jnp.where(visible, self.loss.rho(jnp.sum(error**2, axis=0)), 0.0)

        return _rigid_hessian(item_cost, c)


def _camera_points(
    camera: Pinhole, pose: SE3, points: Float[Array, "3 n"], valid: Bool[Array, " n"], center: Array | None = None
) -> tuple[Any, Any]:
    """Component arrays of the points in the camera frame, with finite values where invisible, and the visible mask."""
    rotation = pose.rotation.matrix()
    moved = matmul(rotation.T, points - pose.translation[:, None])
    moved = moved if center is None else moved + center[:, None]
    visible = valid & camera.in_front_components(moved[0], moved[1], moved[2])
    x, y, z = jnp.where(visible, moved[0], 0.0), jnp.where(visible, moved[1], 0.0), jnp.where(visible, moved[2], 1.0)
    return (x, y, z), visible


def _enough_visible(
    camera: Pinhole, pose: SE3, points: Array, valid: Array, loss: Any, center: Array | None = None
) -> Bool[Array, ""]:
    """At least three points, since rounding can hide that two are degenerate.

    Robust kernels treat a point behind the camera as an outlier; otherwise the pose or the data are wrong.
    """
    _, visible = _camera_points(camera, pose, points, valid, center)
    enough = jnp.sum(visible) >= 3
    return enough & jnp.all(visible == valid) if is_quadratic(loss) else enough


def _mask(
    error: Float[Array, "k n"], visible: Bool[Array, " n"], valid: Bool[Array, " n"], scale: Any
) -> Float[Array, "k n"]:
    hidden = jnp.where(valid & ~visible, _HIDDEN, 0.0).astype(error.dtype)
    return jnp.where(visible[None, :], error * scale, hidden[None, :])


def _pixel_jacobian(camera: Pinhole, c: tuple[Array, Array, Array], weight: Any = 1.0) -> Float[Array, "3 2 n"]:
    """Derivative of the weighted pixel with respect to the point: direction first, then pixel component."""
    x, y, z = c
    inverse = 1.0 / z
    xn, yn = x * inverse, y * inverse
    one, zero = jnp.ones_like(xn), jnp.zeros_like(xn)
    if camera.lens is None:
        xx, yx, xy, yy = one, zero, zero, one
    else:
        _, (xx, yx) = jax.jvp(camera.lens.distort, (xn, yn), (one, zero))
        _, (xy, yy) = jax.jvp(camera.lens.distort, (xn, yn), (zero, one))
    scale = weight * inverse
    ux, uy = (camera.fx * xx + camera.skew * yx) * scale, (camera.fx * xy + camera.skew * yy) * scale
    vx, vy = camera.fy * yx * scale, camera.fy * yy * scale
    rows = ((ux, vx), (uy, vy), (-(ux * xn + uy * yn), -(vx * xn + vy * yn)))
    return jnp.stack([jnp.stack(row) for row in rows])


@checked
def stereo_jacobian(rig: StereoRig, c: tuple[Array, Array, Array]) -> Float[Array, "3 3 n"]:
    """Derivative of (u_left, u_right, v) with respect to the point: direction first, then component."""
    pixel = _pixel_jacobian(rig.camera, c)
    inverse = 1.0 / c[2]
    zero = jnp.zeros_like(inverse)
    approach = jnp.stack([zero, zero, rig.camera.fx * rig.baseline * inverse * inverse])
    return jnp.stack([pixel[:, 0], pixel[:, 0] + approach, pixel[:, 1]], axis=1)


def _pose_jacobian(point_jacobian: Float[Array, "3 k n"], c: tuple[Array, Array, Array]) -> Float[Array, "6 k n"]:
    """Chain rule to the pose's tangent: a right perturbation (v, w) moves the point by ``-v + c x w``."""
    jx, jy, jz = point_jacobian[0], point_jacobian[1], point_jacobian[2]
    x, y, z = (component[None] for component in c)
    return jnp.stack([-jx, -jy, -jz, jy * z - jz * y, jz * x - jx * z, jx * y - jy * x])


def _rigid_hessian(
    item_cost: Any, c: tuple[Array, Array, Array], levers: tuple[Array, Array, Array] | None = None
) -> Float[Array, "6 6"]:
    """Hessian, along the tangent of a pose, of a sum of costs of points in the frame of the camera, at a minimum.

    The chain rule to second order: the Hessian A of a cost in its point gives ``D^T A D`` with the derivative D of the
    point, and its gradient g multiplies the second derivative of ``exp(-d) c``, of which ``g . (w x (w x c)) / 2``
    remains where the gradients sum to zero.
    """
    one, zero = jnp.ones_like(c[0]), jnp.zeros_like(c[0])

    def slope(*c: Array) -> tuple[Array, ...]:
        return jax.vjp(item_cost, *c)[1](one)

    axes = ((one, zero, zero), (zero, one, zero), (zero, zero, one))
    curvature = jnp.stack([jnp.stack(jax.jvp(slope, c, axis)[1]) for axis in axes])
    eye = jnp.stack([jnp.stack(axis) for axis in axes])
    levers = c if levers is None else levers
    moves = _pose_jacobian(eye, levers)
    bent = _pose_jacobian(curvature, levers)
    size = moves.shape[0]
    product = matmul(moves.reshape(size, -1), bent.reshape(size, -1).T)
    lever = matmul(jnp.stack(slope(*c)), jnp.stack(levers).T)
    turning = 0.5 * (lever + lever.T) - jnp.trace(lever) * jnp.eye(3, dtype=lever.dtype)
    return product.at[3:, 3:].add(turning)


def _lower_product(lower: Float[Array, "3 3 n"], vector: Float[Array, "3 n"]) -> Float[Array, "3 n"]:
    return jnp.stack(
        [
            lower[0, 0] * vector[0],
            lower[1, 0] * vector[0] + lower[1, 1] * vector[1],
            lower[2, 0] * vector[0] + lower[2, 1] * vector[1] + lower[2, 2] * vector[2],
        ]
    )


@filter_jit
@checked
def whitener(covariances: Float[Array, "n 3 3"]) -> Float[Array, "3 3 n"]:
    """Inverse Cholesky factors of many 3x3 covariances, unrolled, points along the last axis.

    Args:
        covariances: positive definite.

    Returns:
        Lower triangular ``W`` with ``W S W^T = I``.
    """
    s = jnp.moveaxis(covariances, 0, -1)
    tiny = jnp.finfo(s.dtype).tiny
    root = lambda pivot: 1.0 / jnp.sqrt(jnp.maximum(pivot, tiny))  # noqa: E731
    a = root(s[0, 0])
    l10, l20 = s[1, 0] * a, s[2, 0] * a
    b = root(s[1, 1] - l10 * l10)
    l21 = (s[2, 1] - l20 * l10) * b
    c = root(s[2, 2] - l20 * l20 - l21 * l21)
    zero = jnp.zeros_like(a)
    w10 = -l10 * a * b
    rows = ((a, zero, zero), (w10, b, zero), (-(l20 * a + l21 * w10) * c, -l21 * b * c, c))
    return jnp.stack([jnp.stack(row) for row in rows])
