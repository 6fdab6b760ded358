"""Geometry of pallets, and their pose from the four vertical edges of the fork holes.

The pallet stands on the ground before a level camera. Frames of the ground have x forward and y left; that of the
pallet has its origin in the middle of the face, x in the direction in which forks enter and y along the face to the
left. The column of a vertical edge in the image of a level camera depends on its bearing only:
``y_i = f y / x``, left of the principal point.

References:
    A. Kelly, *Mobile Robotics*, lecture 9.2.4.2.2, "Example: locate a pallet" [K-74, K-76].
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxloc._arguments import checked
from jaxloc._jit import filter_jit
from jaxloc._linalg import matmul
from jaxloc.beliefs.validity import positive
from jaxloc.poses import SE2
from jaxloc.poses.lie_group import as_floats
from jaxloc.solvers import Estimate, LevenbergMarquardt, Linearization, Problem, Quadratic, solve
from jaxloc.solvers.estimate import guarded

_NEAREST = 0.05  # least distance of edges from the plane of the camera, m
_HIDDEN = 1e3


class PalletType(eqx.Module):
    """Front of a kind of pallet: two fork holes beside a central block of a face that stands on the ground.

    Args:
        hole_width: of each hole, m.
        separation: between the holes: the width of the middle block, m.
        hole_bottom: lower rim of the holes above the ground, m.
        hole_height: m.
        face_width: m.
        face_height: upper rim of the face above the ground, m.
    """

    hole_width: Float[Array, ""]
    separation: Float[Array, ""]
    hole_bottom: Float[Array, ""]
    hole_height: Float[Array, ""]
    face_width: Float[Array, ""]
    face_height: Float[Array, ""]

    def __init__(
        self,
        hole_width: Any,
        separation: Any,
        hole_bottom: Any = 0.022,
        hole_height: Any = 0.1,
        face_width: Any = 1.2,
        face_height: Any = 0.144,
    ):
        sizes = as_floats(hole_width, separation, hole_bottom, hole_height, face_width, face_height)
        self.hole_width, self.separation, self.hole_bottom, self.hole_height, self.face_width, self.face_height = sizes

    def edges(self) -> Float[Array, "4"]:
        """Positions of the four vertical edges along the face, from left (positive) to right, m."""
        inner, outer = 0.5 * self.separation, 0.5 * self.separation + self.hole_width
        return jnp.stack([outer, inner, -inner, -outer])

    def ratio(self) -> Float[Array, ""]:
        """Hole width over separation, nearly independent of range in the image [K-74]."""
        return self.hole_width / self.separation


def euro_long() -> PalletType:
    """The long side of the EPAL 1 pallet, 1200 mm: holes of 382.5 mm beside a block of 145 mm."""
    return PalletType(0.3825, 0.145)


def euro_short() -> PalletType:
    """The short side of the EPAL 1 pallet, 800 mm: holes of 227.5 mm beside a block of 145 mm."""
    return PalletType(0.2275, 0.145, face_width=0.8)


def block_narrow() -> PalletType:
    """A face of 1000 mm with holes of 250 mm beside a block of 300 mm."""
    return PalletType(0.25, 0.3, face_width=1.0)


@checked
def hole_ratio(bearings: Float[Array, "4"]) -> Float[Array, ""]:
    """Mean width of the holes over their separation in the image; independent of range for a frontal view.

    Args:
        bearings: the four edges in the image, left to right, any unit and sign.

    Returns:
        The ratio, zero where the separation is zero.

    References:
        KELLY 9.2.4.2.2, scale-independent ratio of hole width to hole separation [K-74].

    Example:
        >>> import jax.numpy as jnp
        >>> float(hole_ratio(jnp.array([3.0, 1.0, -1.0, -3.0])))
        1.0
    """
    gap = bearings[1] - bearings[2]
    distinct = gap != 0
    return jnp.where(
        distinct, 0.5 * (bearings[0] - bearings[1] + bearings[2] - bearings[3]) / jnp.where(distinct, gap, 1.0), 0
    )


@checked
def cross_ratio(bearings: Float[Array, "4"]) -> Float[Array, ""]:
    """``(a - c)(b - d) / ((b - c)(a - d))``: invariant to the pose; zero where undefined.

    Example:
        >>> import jax.numpy as jnp
        >>> round(float(cross_ratio(jnp.array([3.0, 1.0, -1.0, -3.0]))), 4)
        1.3333
    """
    a, b, c, d = bearings
    below = (b - c) * (a - d)
    some = below != 0
    return jnp.where(some, (a - c) * (b - d) / jnp.where(some, below, 1.0), 0.0)


@filter_jit
@checked
def edge_bearings(pose: SE2, edges: Float[Array, " n"], focal: Any) -> Float[Array, " n"]:
    """Bearings of vertical edges of a pallet in the image: ``y_i = f y / x`` px left of the principal column [K-76].

    Args:
        pose: of the pallet in the ground frame below the camera, ``T_ground_pallet``.
        edges: along the face, m.
        focal: of the level camera, px.

    Returns:
        Bearings, px, positive to the left; zero for edges that are not in front.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> from jaxloc.refinement.pallet import edge_bearings
        >>> edge_bearings(jl.poses.SE2(2.0, 0.5, 0.0), jnp.array([0.5, -0.5]), 100.0).tolist()
        [50.0, 0.0]
    """
    x, y, in_front = _places(pose, edges)
    return jnp.where(in_front, focal * y / x, 0.0)


@filter_jit
@checked
def printed_jacobian(pose: SE2, edges: Float[Array, " n"], focal: Any) -> Float[Array, "3 n"]:
    """Derivative of the bearings by the pallet's (x, y, heading) as printed in the lecture, edges last.

    ``H = [-f y_d / x_d^2, f / x_d] [[1, 0, -(y_d - y_m)], [0, 1, x_d - x_m]]`` for the place (x_d, y_d) of an edge and
    that of the pallet (x_m, y_m), both in the frame of the camera.

    Args:
        pose: ``T_ground_pallet``.
        edges: along the face, m.
        focal: px.

    Returns:
        "3 n", zero for edges that are not in front.

    References:
        KELLY 9.2.4.2.2 [K-76]; the second factor is the compound-left Jacobian.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> from jaxloc.refinement.pallet import printed_jacobian
        >>> printed_jacobian(jl.poses.SE2(2.0, 0.0, 0.0), jnp.array([0.5]), 100.0)[:, 0].tolist()
        [-12.5, 50.0, 6.25]
    """
    x, y, in_front = _places(pose, edges)
    by_x, by_y = -focal * y / (x * x), focal / x
    turn = -by_x * (y - pose.y) + by_y * (x - pose.x)
    return jnp.where(in_front[None, :], jnp.stack([by_x, by_y, turn]), 0.0)


class PalletEdges(Problem):
    """Least-squares problem of bearings of a pallet's edges; the state is its pose ``T_ground_pallet``.

    Attributes:
        edges: along the face, m.
        bearings: measured, px left of the principal column; finite.
        focal: px.
        whitening: one over the standard deviation of a bearing; zero for masked edges.
        loss: robust kernel.
    """

    edges: Float[Array, " n"]
    bearings: Float[Array, " n"]
    focal: Float[Array, ""]
    whitening: Float[Array, " n"]
    loss: Any = Quadratic()

    def residual(self, state: SE2) -> Float[Array, "1 n"]:
        """Whitened errors of bearings; a large constant where the edge is not in front."""
        _, _, in_front = _places(state, self.edges)
        error = (edge_bearings(state, self.edges, self.focal) - self.bearings) * self.whitening
        return jnp.where(in_front, error, jnp.where(self.whitening > 0, _HIDDEN, 0.0).astype(error.dtype))[None, :]

    def linearize(self, state: SE2) -> Linearization:
        """With the printed Jacobian, its translation rotated into the axes of the pallet."""
        slope = printed_jacobian(state, self.edges, self.focal)
        rotated = jnp.concatenate([matmul(state.rotation.matrix().T, slope[:2]), slope[2:]])
        return Linearization(self.residual(state), (rotated * self.whitening[None, :])[:, None, :])

    def admissible(self, state: SE2) -> Bool[Array, ""]:
        """Whether all edges are in front of the camera and the face is towards it."""
        _, _, in_front = _places(state, self.edges)
        normal = jnp.sum(state.rotation.matrix()[:, 0] * state.translation)
        return jnp.all(in_front | (self.whitening <= 0)) & (normal > 0)


@filter_jit
@checked
def pose_from_edges(
    kind: PalletType,
    bearings: Float[Array, "4"],
    focal: Any,
    *,
    initial: SE2 | None = None,
    sigma: Any = 0.1,
    valid: Bool[Array, "4"] | None = None,
) -> Estimate:
    """Pose of a pallet from the bearings of the four vertical edges of its fork holes.

    Minimizes ``sum (f y_k / x_k - y_i,k)^2 / (2 sigma^2)`` with a step that is shortened until the cost falls.

    Args:
        kind: of pallet.
        bearings: of the edges from left to right, px left of the principal column.
        focal: px.
        initial: ``T_ground_pallet``; by default a frontal pallet at the distance that its width gives.
        sigma: standard deviation of a bearing, px: a number or one an edge.
        valid: edges that are used, at least three; non-finite ones never are.

    Returns:
        Estimate of ``T_ground_pallet``. ``ok`` is False with fewer than three edges, or when the pallet would be
        behind the camera or seen from the back.

    References:
        KELLY 9.2.4.2.2: four stacked residuals, minimized by line search along the gradient [K-76].

    Example:
        >>> import jaxloc as jl
        >>> from jaxloc.refinement.pallet import edge_bearings, euro_long, pose_from_edges
        >>> bearings = edge_bearings(jl.poses.SE2(2.0, 0.3, 0.2), euro_long().edges(), 800.0)
        >>> fit = pose_from_edges(euro_long(), bearings, 800.0)
        >>> bool(fit.ok), round(float(fit.value.x), 3), round(float(fit.value.theta), 3)
        (True, 2.0, 0.2)
    """
    usable = jnp.isfinite(bearings)
    usable = usable if valid is None else usable & valid
    bearings = jnp.where(usable, bearings, 0.0)
    dtype = bearings.dtype
    sigmas = jnp.broadcast_to(jnp.asarray(sigma, dtype), bearings.shape)
    focal, edges = jnp.asarray(focal, dtype), kind.edges().astype(dtype)
    usable = usable & positive(sigmas)
    whitening = jnp.where(usable, 1.0 / jnp.where(usable, sigmas, 1.0), 0.0)
    first = _frontal(edges, bearings, focal, usable) if initial is None else initial

    def run(problem: PalletEdges, first: SE2) -> Estimate:
        return solve(problem, first, solver=LevenbergMarquardt())

    return guarded(jnp.array(True), run, PalletEdges(edges, bearings, focal, whitening), first)


def _frontal(edges: Array, bearings: Array, focal: Array, usable: Array) -> SE2:
    """A frontal pallet, by a straight line through bearings over edges."""
    count = jnp.maximum(jnp.sum(usable), 1).astype(edges.dtype)
    middle, mean = (jnp.sum(jnp.where(usable, v, 0.0)) / count for v in (edges, bearings))
    across = jnp.where(usable, edges - middle, 0.0)
    variance = jnp.sum(across**2)
    scale = jnp.sum(across * (bearings - mean)) / jnp.where(variance > 0, variance, 1.0)
    # At least a pixel over the width, so that the initial pose is finite.
    x = focal / jnp.maximum(scale, 1.0)
    return SE2(x, mean * x / focal - middle, jnp.zeros_like(x))


def _places(pose: SE2, edges: Float[Array, " n"]) -> tuple[Array, Array, Bool[Array, " n"]]:
    """Edges in the frame of the camera, finite where they are not in front of it, and the mask of those in front."""
    rotation = pose.rotation.matrix()
    x, y = (rotation[i, 1] * edges + pose.translation[i] for i in range(2))
    in_front = x > _NEAREST
    return jnp.where(in_front, x, 1.0), jnp.where(in_front, y, 0.0), in_front
