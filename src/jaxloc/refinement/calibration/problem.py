"""Least-squares problems of calibration: shared unknowns and a board pose for each image.

The Jacobian has the shape of an arrow: an image depends on the shared unknowns and its own pose. Derivatives are taken
forward, image by image, in those few directions alone.
"""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxloc._arguments import checked
from jaxloc._linalg import matmul
from jaxloc.poses import SE3, retract, tangent_dimension
from jaxloc.refinement.calibration.model import Parametrization
from jaxloc.sensors import Pinhole
from jaxloc.solvers import Linearization, Problem, Quadratic
from jaxloc.solvers.problem import items, with_losses

# Residual of a corner behind the camera, sigmas: large, so that no step moves boards there.
_HIDDEN = 1e4
_LEAST_TILT = 0.025  # boards whose normals all lie within this angle of one direction count as parallel, rad


class Unknowns(eqx.Module):
    """Unknowns of calibration.

    Attributes:
        shared: by all images.
        boards: a pose for each image, ``T_camera_board`` of the (left) camera.
    """

    shared: Any
    boards: SE3


class Rig(eqx.Module):
    """Unknowns of two cameras, shared by all images.

    Attributes:
        left: unknowns of the left camera.
        right: of the right one.
        T_left_right: pose of the right camera in the left one's frame.
    """

    left: Float[Array, " u"]
    right: Float[Array, " v"]
    T_left_right: SE3


class BoardProblem(Problem):
    """Boards with a pose each; subclasses define the projection of a board.

    The residual is a pair: pixel errors, and for unused images the distance from the identity pose, which keeps
    the normal equations regular.

    Attributes:
        board: "3 m", m.
        pixels: "n 2 k", px; k corners an image, of all cameras.
        valid: those that are used.
        sigma: of a coordinate of a corner, px.
    """

    board: eqx.AbstractVar[Float[Array, "3 m"]]
    pixels: eqx.AbstractVar[Float[Array, "n 2 k"]]
    valid: eqx.AbstractVar[Bool[Array, "n k"]]
    sigma: eqx.AbstractVar[Float[Array, ""]]

    @abstractmethod
    def predict(self, shared: Any, pose: SE3) -> tuple[Float[Array, "2 k"], Bool[Array, " k"]]:
        """Pixels of the corners of one board, and which are in front of the cameras."""

    @property
    @abstractmethod
    def num_pinhole(self) -> int:
        """Number of pinhole unknowns."""

    @abstractmethod
    def is_valid(self, shared: Any) -> Bool[Array, ""]:
        """Whether the shared unknowns are a valid camera."""

    @checked
    def one(self, shared: Any, pose: SE3, pixels: Float[Array, "2 k"], valid: Bool[Array, " k"]) -> tuple[Array, Array]:
        """Residual of one board."""
        predicted, in_front = self.predict(shared, pose)
        error = jnp.where((valid & in_front)[None, :], predicted - pixels, 0.0) / self.sigma
        penalty = jnp.where(valid & ~in_front, _HIDDEN, 0.0).astype(error.dtype)
        return error + penalty[None, :], jnp.where(jnp.any(valid), 0.0, _pose_residual(pose))

    def residual(self, state: Unknowns) -> tuple[Float[Array, "2 i"], Float[Array, "6 n"]]:
        """Whitened errors of all boards."""
        errors, idle = jax.vmap(self.one, (None, 0, 0, 0))(state.shared, state.boards, self.pixels, self.valid)
        return _flat(errors), idle.T

    def linearize(self, state: Unknowns) -> Linearization:
        """Residual and Jacobian, image by image."""
        shared = tangent_dimension(state.shared)

        def local(pose: SE3, pixels: Array, valid: Array) -> tuple[Any, Any]:
            def moved(delta: Array) -> tuple[Array, Array]:
                return self.one(retract(state.shared, delta[:shared]), pose.retract(delta[shared:]), pixels, valid)

            zero = jnp.zeros(shared + SE3.dof, self.sigma.dtype)
            value, push = jax.linearize(moved, zero)
            return value, jax.vmap(push)(jnp.eye(zero.size, dtype=zero.dtype))

        (errors, idle), (slopes, idle_slopes) = jax.vmap(local)(state.boards, self.pixels, self.valid)
        jacobian = _arrow(slopes, shared), _arrow(idle_slopes[..., None], shared)
        return Linearization((_flat(errors), idle.T), jacobian)

    def hessian(self, state: Unknowns) -> Float[Array, "d d"]:
        """Exact Hessian at a minimum, image by image."""
        shared, count = tangent_dimension(state.shared), self.pixels.shape[0]

        def local(pose: SE3, pixels: Array, valid: Array) -> Array:
            def cost(delta: Array) -> Array:
                parts = self.one(retract(state.shared, delta[:shared]), pose.retract(delta[shared:]), pixels, valid)
                costs = [
                    jnp.sum(kernel.rho(jnp.sum(items(r) ** 2, axis=0)))
                    for kernel, r in with_losses(self.loss, (parts[0], parts[1][:, None]))
                ]
                return costs[0] + costs[1]

            return jax.hessian(cost)(jnp.zeros(shared + SE3.dof, self.sigma.dtype))

        blocks = jax.vmap(local)(state.boards, self.pixels, self.valid)
        corner = jnp.sum(blocks[:, :shared, :shared], axis=0)
        side = jnp.swapaxes(blocks[:, shared:, :shared], 0, 1)
        side = jnp.swapaxes(side, 0, 1).reshape(count * SE3.dof, shared)
        own = jnp.eye(count, dtype=corner.dtype)[:, None, :, None] * blocks[:, shared:, shared:][:, :, None, :]
        return jnp.block([[corner, side.T], [side, own.reshape(count * SE3.dof, -1)]])

    def admissible(self, state: Unknowns) -> Bool[Array, ""]:
        """Whether the cameras are valid, all corners are in front of them, and there are enough boards.

        A board gives two constraints on a camera [T-17]; parallel boards give the same two.
        """
        _, in_front = jax.vmap(self.predict, (None, 0))(state.shared, state.boards)
        views = jnp.where(has_tilts(state.boards, self.valid), jnp.sum(jnp.any(self.valid, axis=1)), 1)
        enough = 2 * views >= self.num_pinhole
        return self.is_valid(state.shared) & jnp.all(in_front | ~self.valid) & enough


class CameraProblem(BoardProblem):
    """Calibration of one camera; shared are its unknowns."""

    parametrization: Parametrization
    board: Float[Array, "3 m"]
    pixels: Float[Array, "n 2 m"]
    valid: Bool[Array, "n m"]
    sigma: Float[Array, ""]
    loss: Any = Quadratic()

    @checked
    def predict(self, shared: Any, pose: SE3) -> tuple[Float[Array, "2 m"], Bool[Array, " m"]]:
        """Pixels of the corners of one board, and which are in front of the camera."""
        return project(self.parametrization.camera(shared), pose, self.board)

    @property
    def num_pinhole(self) -> int:
        """Number of pinhole unknowns."""
        return len(self.parametrization.intrinsics.free_pinhole())

    def is_valid(self, shared: Any) -> Bool[Array, ""]:
        """Whether focal lengths are positive."""
        return _positive(self.parametrization.camera(shared))


class StereoProblem(BoardProblem):
    """Calibration of a stereo pair; shared is a `Rig`. Corners of the right image follow those of the left one."""

    left: Parametrization
    right: Parametrization
    board: Float[Array, "3 m"]
    pixels: Float[Array, "n 2 k"]
    valid: Bool[Array, "n k"]
    sigma: Float[Array, ""]
    loss: Any = Quadratic()

    @checked
    def predict(self, shared: Any, pose: SE3) -> tuple[Float[Array, "2 k"], Bool[Array, " k"]]:
        """Pixels of the corners of one board, and which are in front of the cameras."""
        in_left, in_front = project(self.left.camera(shared.left), pose, self.board)
        other = shared.T_left_right.inverse() @ pose
        in_right, in_front_of_right = project(self.right.camera(shared.right), other, self.board)
        return jnp.concatenate([in_left, in_right], axis=1), jnp.concatenate([in_front, in_front_of_right])

    @property
    def num_pinhole(self) -> int:
        """Number of pinhole unknowns of one camera."""
        return max(len(side.intrinsics.free_pinhole()) for side in (self.left, self.right))

    def is_valid(self, shared: Any) -> Bool[Array, ""]:
        """Whether focal lengths are positive."""
        return _positive(self.left.camera(shared.left)) & _positive(self.right.camera(shared.right))


@checked
def project(camera: Pinhole, pose: SE3, board: Float[Array, "3 m"]) -> tuple[Float[Array, "2 m"], Bool[Array, " m"]]:
    """Pixels of points of a board at ``T_camera_board``, and which are in front of the camera."""
    moved = matmul(pose.rotation.matrix(), board) + pose.translation[:, None]
    in_front = moved[2] > 0.0
    depth = jnp.where(in_front, moved[2], 1.0)
    x, y = jnp.where(in_front, moved[0], 0.0), jnp.where(in_front, moved[1], 0.0)
    return jnp.stack(camera.project_components(x, y, depth)), in_front


@checked
def has_tilts(boards: SE3, valid: Bool[Array, "n k"]) -> Bool[Array, ""]:
    """Whether the boards are not all parallel."""
    used = jnp.any(valid, axis=1)
    normals = jnp.where(used[:, None], boards.rotation.rotation_matrix[:, :, 2], 0.0)
    count = jnp.maximum(jnp.sum(used), 1).astype(normals.dtype)
    largest = jnp.linalg.norm(jnp.sum(normals, axis=0)) / count
    return largest < 1.0 - 0.5 * _LEAST_TILT**2


def _pose_residual(pose: SE3) -> Float[Array, "6"]:
    """Zero at the identity with unit derivative, and smooth everywhere, unlike the logarithm."""
    r = pose.rotation.rotation_matrix
    turn = 0.5 * jnp.stack([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])
    return jnp.concatenate([pose.translation, turn])


def _positive(camera: Pinhole) -> Bool[Array, ""]:
    return (camera.fx > 0) & (camera.fy > 0)


def _flat(errors: Float[Array, "n 2 k"]) -> Float[Array, "2 i"]:
    return jnp.swapaxes(errors, 0, 1).reshape(2, -1)


def _arrow(slopes: Float[Array, "n d c k"], shared: int) -> Float[Array, "w c i"]:
    """Arrow-shaped Jacobian: shared directions first, then six for each pose."""
    count, _, components, size = slopes.shape
    common = jnp.moveaxis(slopes[:, :shared], 0, 2).reshape(shared, components, count * size)
    eye = jnp.eye(count, dtype=slopes.dtype)
    own = eye[:, None, None, :, None] * slopes[:, shared:, :, None, :]
    own = own.reshape(count * SE3.dof, components, count * size)
    return jnp.concatenate([common, own])
