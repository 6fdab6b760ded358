"""Bundle adjustment problem: observations, unknowns, gauge, and costs with their derivatives.

Observations lie along the last axis, components along the first, for speed.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxloc import _linalg
from jaxloc._arguments import checked
from jaxloc._linalg import matmul
from jaxloc.beliefs.validity import positive
from jaxloc.poses import SE3
from jaxloc.refinement.bundle.structure import Structure
from jaxloc.sensors import Pinhole, StereoRig
from jaxloc.solvers import Loss, Quadratic

# Residual of an invisible point, sigmas: large, so that no step moves points behind a camera.
_HIDDEN = 1e3


class Observations(eqx.Module):
    """Observations of points by cameras; a fixed number of slots, of which some may be empty.

    Attributes:
        camera: "m", index of the camera.
        point: "m", index of the point.
        measured: "m k", px: (u, v) of a camera, (u_left, u_right, v) of a stereo rig.
        sigma: "m k", standard deviation of each coordinate, px.
        valid: slots that are used; others may hold any numbers, nan too.

    Example:
        >>> import jax.numpy as jnp
        >>> from jaxloc.refinement.bundle.problem import Observations
        >>> Observations.of(jnp.array([0, 1]), jnp.array([0, 0]), jnp.zeros((2, 3)), sigma=0.5).sigma.shape
        (2, 3)
    """

    camera: Int[Array, " m"]
    point: Int[Array, " m"]
    measured: Float[Array, "m k"]
    sigma: Float[Array, "m k"]
    valid: Bool[Array, " m"]

    @staticmethod
    def of(camera: Any, point: Any, measured: Any, *, sigma: Any = 1.0, valid: Any = None) -> "Observations":
        """Observations with one sigma for all (or "k" for the components, or "m k"), all of them valid by default."""
        measured = jnp.asarray(measured)
        sigma = jnp.asarray(sigma, measured.dtype)
        lead = (1,) * (measured.ndim - sigma.ndim)
        valid = jnp.ones(measured.shape[:1], bool) if valid is None else jnp.asarray(valid)
        index = (jnp.asarray(camera, jnp.int32), jnp.asarray(point, jnp.int32))
        return Observations(
            *index, measured, jnp.broadcast_to(sigma.reshape(lead + sigma.shape), measured.shape), valid
        )


class Bundle(eqx.Module):
    """The unknowns of bundle adjustment.

    Attributes:
        poses: stack of c poses ``T_world_camera`` (of the left cameras).
        points: "n 3", world frame, m.
    """

    poses: SE3
    points: Float[Array, "n 3"]

    @checked
    def moved(self, cameras: Float[Array, "c 6"], points: Float[Array, "n 3"]) -> "Bundle":
        """The bundle with poses retracted (right perturbation) and points added to."""
        return Bundle(jax.vmap(lambda pose, delta: pose.retract(delta))(self.poses, cameras), self.points + points)


class Gauge(eqx.Module):
    """Gauge of a bundle: fixed poses or pose priors, since images determine neither its pose nor, for mono, its scale.

    Attributes:
        fixed: cameras whose poses are constant.
        anchors: means of pose priors, or None.
        information: of the priors, in the tangent of the anchors; zero where a camera is free.
    """

    fixed: Bool[Array, " c"]
    anchors: SE3 | None = None
    information: Float[Array, "c 6 6"] | None = None

    @staticmethod
    def fix(num_cameras: int, *cameras: int) -> "Gauge":
        """Fixed cameras: one for a stereo rig; two for a single camera, whose distance determines the scale."""
        return Gauge(jnp.zeros(num_cameras, bool).at[jnp.asarray(cameras, jnp.int32)].set(True))

    @staticmethod
    @checked
    def prior(poses: SE3, covariance: Float[Array, "c 6 6"], valid: Bool[Array, " c"]) -> "Gauge":
        """Pose priors with covariances, where ``valid``."""
        eye = jnp.eye(6, dtype=covariance.dtype)
        safe = jnp.where(valid[:, None, None], covariance, eye[None])
        information = jnp.where(valid[:, None, None], jax.vmap(_linalg.inverse)(safe), 0.0)
        return Gauge(jnp.zeros(valid.shape, bool), poses, information)

    @checked
    def cost(self, poses: SE3) -> Float[Array, ""]:
        """Half the squared Mahalanobis distance from the anchors."""
        if self.anchors is None or self.information is None:
            return jnp.zeros((), poses.translation.dtype)
        return jnp.sum(jax.vmap(_anchor_cost)(poses, self.anchors, self.information))

    @checked
    def gradients(self, poses: SE3) -> Float[Array, "c 6"]:
        """Gradient of the cost in the tangents of the poses."""
        if self.anchors is None or self.information is None:
            return jnp.zeros((*poses.batch_shape, 6), poses.translation.dtype)
        return jax.vmap(_anchor_gradient)(poses, self.anchors, self.information)

    @checked
    def hessians(self, poses: SE3, exact: bool) -> Float[Array, "c 6 6"]:
        """Hessian of the cost: Gauss-Newton, or exact."""
        if self.anchors is None or self.information is None:
            return jnp.zeros((*poses.batch_shape, 6, 6), poses.translation.dtype)

        def hessian(pose: SE3, anchor: SE3, information: Array) -> Array:
            if exact:
                slope = jax.jacfwd(lambda delta: _anchor_gradient(pose.retract(delta), anchor, information))
                bent = slope(jnp.zeros(6, information.dtype))
                return 0.5 * (bent + bent.T)
            jacobian = SE3.left_jacobian_inverse(-anchor.local(pose))
            return matmul(jacobian.T, matmul(information, jacobian))

        return jax.vmap(hessian)(poses, self.anchors, self.information)


def _anchor_cost(pose: SE3, anchor: SE3, information: Float[Array, "6 6"]) -> Float[Array, ""]:
    distance = anchor.local(pose)
    return 0.5 * jnp.sum(distance * matmul(information, distance))


def _anchor_gradient(pose: SE3, anchor: SE3, information: Float[Array, "6 6"]) -> Float[Array, "6"]:
    distance = anchor.local(pose)
    return matmul(SE3.left_jacobian_inverse(-distance).T, matmul(information, distance))


class ObservationCosts(eqx.Module):
    """Costs of the observations as functions of the points in the cameras' frames.

    Attributes:
        cost: sum over all observations, hidden ones included.
        visible: observations whose point is in front of the camera.
        frame: points in the frames of the cameras; finite where hidden.
        rotation: of the cameras.
        gradient: of the cost in the frame of the camera; zero where hidden.
        hessian: of the cost.
        information: ``w J^T J``, the weighted Gauss-Newton Hessian.
    """

    cost: Float[Array, ""]
    visible: Bool[Array, " m"]
    frame: Float[Array, "3 m"]
    rotation: Float[Array, "3 3 m"]
    gradient: Float[Array, "3 m"]
    hessian: Float[Array, "3 3 m"]
    information: Float[Array, "3 3 m"]


class BundleProblem(eqx.Module):
    """``sum rho(|W (h(T_c^-1 X_p) - z)|^2)`` over observations, and the cost of the gauge.

    Attributes:
        model: the camera or stereo rig of all images.
        camera: of each observation.
        point: of each observation.
        measured: "k m", px; finite everywhere.
        inverse_sigma: "k m", 1/px; finite everywhere.
        usable: observations that are used.
        gauge: fixed poses or priors.
        loss: robust kernel over the components of an observation.
    """

    model: Pinhole | StereoRig
    camera: Int[Array, " m"]
    point: Int[Array, " m"]
    measured: Float[Array, "k m"]
    inverse_sigma: Float[Array, "k m"]
    usable: Bool[Array, " m"]
    gauge: Gauge
    loss: Loss = Quadratic()

    @staticmethod
    def of(model: Any, initial: Bundle, observations: Observations, gauge: Gauge, loss: Loss) -> "BundleProblem":
        """The problem, with observations masked that are not finite, or whose point has too few rays."""
        measured, sigma = observations.measured, observations.sigma
        camera, point = observations.camera, observations.point
        good = jnp.all(jnp.isfinite(measured) & positive(sigma), axis=1) & observations.valid
        cameras, points = initial.poses.batch_shape[0], initial.points.shape[0]
        good = good & (camera >= 0) & (camera < cameras) & (point >= 0) & (point < points)
        camera, point = jnp.where(good, camera, 0), jnp.where(good, point, 0)
        good = good & jnp.all(jnp.isfinite(initial.points), axis=1)[point]
        rays = jax.ops.segment_sum(good.astype(jnp.int32), point, points)
        good = good & (rays >= (1 if isinstance(model, StereoRig) else 2))[point]
        safe = jnp.where(good[:, None], measured, 0.0), 1.0 / jnp.where(good[:, None], sigma, 1.0)
        return BundleProblem(model, camera, point, safe[0].T, safe[1].T, good, gauge, loss)

    @checked
    def project(self, frame: Float[Array, "3 m"]) -> Float[Array, "k m"]:
        """Measurements predicted for points in the camera's frame."""
        shown = self.model.project_components(frame[0], frame[1], frame[2])
        return shown if isinstance(self.model, StereoRig) else jnp.stack(shown)

    def frames(self, state: Bundle) -> tuple[Float[Array, "3 m"], Float[Array, "3 3 m"], Bool[Array, " m"]]:
        """Points in the frames of their cameras, the cameras' rotations, and the visible mask."""
        rotation = jnp.moveaxis(state.poses.rotation.rotation_matrix, 0, -1)[:, :, self.camera]
        arm = state.points.T[:, self.point] - state.poses.translation.T[:, self.camera]
        moved = jnp.sum(rotation * arm[:, None, :], axis=0)
        camera = self.model.camera if isinstance(self.model, StereoRig) else self.model
        visible = self.usable & camera.in_front_components(moved[0], moved[1], moved[2])
        forward = jnp.array([0.0, 0.0, 1.0], moved.dtype)[:, None]
        return jnp.where(visible[None], moved, forward), rotation, visible

    @checked
    def item_cost(self, frame: Float[Array, "3 m"]) -> Float[Array, " m"]:
        """Cost of each observation for points in the frames of the cameras."""
        error = (self.project(frame) - self.measured) * self.inverse_sigma
        return self.loss.rho(jnp.sum(error**2, axis=0))

    def cost(self, state: Bundle) -> Float[Array, ""]:
        """The exact objective; points behind an observing camera have a large constant cost."""
        frame, _, visible = self.frames(state)
        return self._total(self.item_cost(frame), visible) + self.gauge.cost(state.poses)

    def _total(self, items: Float[Array, " m"], visible: Bool[Array, " m"]) -> Float[Array, ""]:
        hidden = self.loss.rho(jnp.full((1,), _HIDDEN**2, items.dtype))
        return jnp.sum(jnp.where(visible, items, jnp.where(self.usable, hidden, 0.0)))

    def observation_costs(self, state: Bundle, *, near: Any = True, exact: bool = False) -> ObservationCosts:
        """Cost, gradient and Hessian of each observation.

        The Hessians are positive semidefinite unless exact: the negative part due to decreasing robust weights is used
        only ``near`` a minimum, and bounded so that a tenth remains.
        """
        frame, rotation, visible = self.frames(state)
        error = (self.project(frame) - self.measured) * self.inverse_sigma
        squared = jnp.sum(error**2, axis=0)
        jacobian = self.inverse_sigma[None] * _along_axes(self.project, frame)
        weight, decrease = jax.jvp(self.loss.weight, (squared,), (jnp.ones_like(squared),))
        score = jnp.sum(jacobian * error[None], axis=1)
        information = weight[None, None] * jnp.sum(jacobian[:, None] * jacobian[None], axis=2)
        if exact:
            hessian = _along_axes(lambda c: jax.vjp(self.item_cost, c)[1](jnp.ones_like(squared))[0], frame)
        else:
            positive = squared > 0
            decrease = jnp.where(
                positive & near, jnp.maximum(2.0 * decrease, -0.9 * weight / jnp.where(positive, squared, 1.0)), 0.0
            )
            hessian = information + (decrease[None] * score)[:, None] * score[None]
        gradient = jnp.where(visible[None], weight[None] * score, 0.0)
        hessian, information = (jnp.where(visible[None, None], part, 0.0) for part in (hessian, information))
        return ObservationCosts(
            self._total(self.loss.rho(squared), visible), visible, frame, rotation, gradient, hessian, information
        )

    def gradient(self, state: Bundle, structure: Structure) -> tuple[Float[Array, "c 6"], Float[Array, "n 3"]]:
        """Derivative of the exact objective along the tangents of the cameras and of the points."""
        costs = self.observation_costs(state)
        on_points = jnp.sum(costs.rotation * costs.gradient[None], axis=1)
        rows = pose_rows(costs.gradient, costs.frame).T
        cameras = jax.ops.segment_sum(rows, self.camera, structure.by_camera.count)
        points = jax.ops.segment_sum(on_points.T, self.point, structure.by_point.count)
        cameras = jnp.where(self.gauge.fixed[:, None], 0.0, cameras + self.gauge.gradients(state.poses))
        return cameras, points

    def admissible(self, state: Bundle) -> Bool[Array, ""]:
        """Whether all points are in front of their cameras; robust kernels treat others as outliers."""
        return jnp.all(self.frames(state)[2] == self.usable) | ~jnp.array(isinstance(self.loss, Quadratic))


def _along_axes(function: Any, frame: Float[Array, "3 m"]) -> Float[Array, "3 k m"]:
    """Derivative of a function of points: direction first, then the components of the function."""
    axes = jnp.eye(3, dtype=frame.dtype)
    along = lambda axis: jax.jvp(function, (frame,), (jnp.broadcast_to(axis[:, None], frame.shape),))[1]  # noqa: E731
    return jnp.stack([along(axes[i]) for i in range(3)])


@checked
def pose_rows(slope: Float[Array, "3 *k m"], frame: Float[Array, "3 m"]) -> Float[Array, "6 *k m"]:
    """Chain rule to the pose's tangent: a right perturbation (v, w) moves the point by ``-v + c x w``."""
    gx, gy, gz = slope[0], slope[1], slope[2]
    x, y, z = (jnp.broadcast_to(component, gx.shape) for component in frame)
    return jnp.stack([-gx, -gy, -gz, gy * z - gz * y, gz * x - gx * z, gx * y - gy * x])
