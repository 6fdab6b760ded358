"""Arrow-shaped normal equations of bundle adjustment, solved by elimination of the points (Schur complement).

With ``U`` the blocks of cameras, ``V`` those of points and ``W`` those of observations, the reduced system of the
cameras is ``S = U - W V^-1 W^T``: dense, 6c x 6c, for any number of points.

References:
    Triggs, McLauchlan, Hartley and Fitzgibbon, "Bundle adjustment: a modern synthesis", 2000, section 6.1.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxloc._linalg import matmul
from jaxloc.refinement.bundle.problem import Bundle, BundleProblem, ObservationCosts, pose_rows
from jaxloc.refinement.bundle.structure import Structure, with_zero
from jaxloc.solvers.cholesky import Factor, factor, rank_tolerance


class Tangent(eqx.Module):
    """Tangent vector of a bundle, or a derivative along it.

    Attributes:
        cameras: tangents of the poses, (translation, rotation).
        points: of the points.
    """

    cameras: Float[Array, "c 6"]
    points: Float[Array, "n 3"]

    def dot(self, other: "Tangent") -> Float[Array, ""]:
        """Inner product."""
        return jnp.sum(self.cameras * other.cameras) + jnp.sum(self.points * other.points)


class Arrow(eqx.Module):
    """Symmetric arrow matrix over cameras and points; off-diagonal blocks belong to observations.

    Attributes:
        cameras: blocks of the cameras; the identity for fixed ones.
        points: blocks of the points.
        cross: block of camera and point of each observation.
        camera: of each observation.
        point: of each observation.
    """

    cameras: Float[Array, "c 6 6"]
    points: Float[Array, "n 3 3"]
    cross: Float[Array, "m 6 3"]
    camera: Int[Array, " m"]
    point: Int[Array, " m"]

    def product(self, x: Tangent) -> Tangent:
        """The matrix times a vector."""
        cameras = jnp.einsum("cij,cj->ci", self.cameras, x.cameras, precision="highest")
        points = jnp.einsum("nij,nj->ni", self.points, x.points, precision="highest")
        to_camera = jnp.einsum("mij,mj->mi", self.cross, x.points[self.point], precision="highest")
        to_point = jnp.einsum("mij,mi->mj", self.cross, x.cameras[self.camera], precision="highest")
        cameras = cameras + jax.ops.segment_sum(to_camera, self.camera, cameras.shape[0])
        return Tangent(cameras, points + jax.ops.segment_sum(to_point, self.point, points.shape[0]))

    def diagonal(self) -> Tangent:
        """The diagonal."""
        diagonal = lambda blocks: jnp.diagonal(blocks, axis1=1, axis2=2)  # noqa: E731
        return Tangent(diagonal(self.cameras), diagonal(self.points))


class Eliminated(eqx.Module):
    """Factorization of an arrow matrix.

    Attributes:
        system: factor of the reduced system of the cameras.
        deficient: whether the cameras have undetermined directions.
        lower: inverse factors ``L^-1`` of the points' blocks, ``L^-T L^-1 = V^-1``, zero along undetermined directions.
        undetermined: points with undetermined directions.
        gain: ``L^-1 W^T`` of each observation.
        camera: of each observation.
        point: of each observation.
    """

    system: Factor
    deficient: Bool[Array, ""]
    lower: Float[Array, "n 3 3"]
    undetermined: Bool[Array, " n"]
    gain: Float[Array, "m 3 6"]
    camera: Int[Array, " m"]
    point: Int[Array, " m"]

    def solve(self, b: Tangent) -> Tangent:
        """The inverse times a vector; zero along undetermined directions."""
        count = b.cameras.shape[0]
        half = jnp.sum(self.lower * b.points[:, None, :], axis=2)
        shift = jnp.sum(self.gain * half[self.point][:, :, None], axis=1)
        right = b.cameras - jax.ops.segment_sum(shift, self.camera, count)
        cameras = self.system.solve(right.reshape(-1)).reshape(count, 6)
        back = jnp.sum(self.gain * cameras[self.camera][:, None, :], axis=2)
        half = half - jax.ops.segment_sum(back, self.point, half.shape[0])
        return Tangent(cameras, jnp.sum(self.lower * half[:, :, None], axis=1))


def normal_equations(
    problem: BundleProblem, state: Bundle, structure: Structure, *, near: Any = True, exact: bool = False
) -> tuple[Float[Array, ""], Tangent, Arrow]:
    """Cost, gradient and Hessian: Gauss-Newton with the weights of the kernels, or exact."""
    costs = problem.observation_costs(state, near=near, exact=exact)
    gradient, arrow = _sums(problem, state, costs, structure, exact)
    return costs.cost + problem.gauge.cost(state.poses), gradient, arrow


def score_products(problem: BundleProblem, state: Bundle, structure: Structure, eliminated: Eliminated) -> Arrow:
    """Sum of outer products of the observations' gradients: B of the sandwich covariance ``H^-1 B H^-1``.

    Each gradient is divided by one minus the leverage of its observation on its point;
    the leverage on its camera, of the order of a hundredth, is neglected. See `jaxloc.solvers.problem.sandwich`.
    """
    costs = problem.observation_costs(state)
    rotated = jnp.moveaxis(eliminated.lower, 0, -1)[:, :, problem.point]
    rotated = jnp.sum(rotated[:, :, None] * costs.rotation[None], axis=1)
    leverage = jnp.sum(costs.information * jnp.sum(rotated[:, :, None] * rotated[:, None], axis=0), axis=(0, 1))
    slope = costs.gradient / (1.0 - jnp.clip(leverage / problem.measured.shape[0], 0.0, 0.9))[None]
    costs = eqx.tree_at(lambda s: s.hessian, costs, slope[:, None] * slope[None])
    return _sums(problem, state, costs, structure, False)[1]


def _sums(
    problem: BundleProblem, state: Bundle, costs: ObservationCosts, structure: Structure, exact: bool
) -> tuple[Tangent, Arrow]:
    """Sums of gradients and Hessians of all observations and of the gauge."""
    pose_pose, cross, point_point = _blocks(costs, exact)
    free = ~problem.gauge.fixed
    at_sight = free[problem.camera]
    slope = jnp.concatenate([pose_rows(costs.gradient, costs.frame), pose_pose.reshape(36, -1)])
    by_camera = structure.by_camera.sum(slope.T)
    on_point = jnp.sum(costs.rotation * costs.gradient[None], axis=1)
    by_point = structure.by_point.sum(jnp.concatenate([on_point, point_point.reshape(9, -1)]).T)
    cameras = by_camera[:, 6:].reshape(-1, 6, 6) + problem.gauge.hessians(state.poses, exact)
    cameras = jnp.where(free[:, None, None], cameras, jnp.eye(6, dtype=cameras.dtype)[None])
    gradient = jnp.where(free[:, None], by_camera[:, :6] + problem.gauge.gradients(state.poses), 0.0)
    rows = jnp.where(at_sight[None], cross.reshape(18, -1), 0.0).T.reshape(-1, 6, 3)
    arrow = Arrow(cameras, by_point[:, 3:].reshape(-1, 3, 3), rows, problem.camera, problem.point)
    return Tangent(gradient, by_point[:, :3]), arrow


def _blocks(
    costs: ObservationCosts, exact: bool
) -> tuple[Float[Array, "6 6 m"], Float[Array, "6 3 m"], Float[Array, "3 3 m"]]:
    """Hessian blocks of each observation: pose by pose, pose by point, point by point.

    The point in the camera's frame moves as ``exp(-d) (c + R^T e)``. To second order in the tangent d = (v, w) and the
    step e of the point, ``g . (w x (w x c) + w x v) / 2 - g . (w x R^T e)`` is added to the chain rule.
    """
    frame, slope, rotation = costs.frame, costs.gradient, costs.rotation
    along = pose_rows(costs.hessian, frame)
    pose_pose = pose_rows(jnp.swapaxes(along, 0, 1), frame)
    rotated = jnp.sum(costs.hessian[:, None] * rotation[None], axis=2)
    point_point = jnp.sum(rotation[:, :, None] * rotated[None], axis=1)
    if exact:
        x, y, z = slope[0], slope[1], slope[2]
        zero = jnp.zeros_like(x)
        cross = jnp.stack([jnp.stack([zero, -z, y]), jnp.stack([z, zero, -x]), jnp.stack([-y, x, zero])])
        lever = slope[:, None] * frame[None]
        turning = 0.5 * (lever + jnp.swapaxes(lever, 0, 1))
        turning = turning - jnp.sum(slope * frame, axis=0)[None, None] * jnp.eye(3, dtype=slope.dtype)[..., None]
        pose_pose = pose_pose.at[3:, 3:].add(turning).at[:3, 3:].add(0.5 * cross).at[3:, :3].add(-0.5 * cross)
        along = along.at[3:].add(cross)
    return pose_pose, jnp.sum(along[:, None] * rotation[None], axis=2), point_point


def eliminate(arrow: Arrow, structure: Structure, damping: Any = 0.0) -> Eliminated:
    """Factors an arrow matrix with its diagonal increased by a fraction of itself (Marquardt's damping)."""
    lower, undetermined = _point_factors(_damped(arrow.points, damping))
    at_sight = lower[arrow.point]
    gain = jnp.sum(at_sight[:, :, :, None] * jnp.swapaxes(arrow.cross, 1, 2)[:, None], axis=2)
    cameras = _damped(arrow.cameras, damping)
    reduced = _reduced(cameras, gain, structure)
    system = factor(reduced)
    before = jnp.diagonal(cameras, axis1=1, axis2=2).reshape(-1)
    pivots = (jnp.diagonal(system.lower) / system.scale) ** 2
    # Rounding errors of the difference are of the size of its first term.
    deficient = system.deficient | jnp.any(pivots <= rank_tolerance(before.dtype) * before)
    return Eliminated(system, deficient, lower, undetermined, gain, arrow.camera, arrow.point)


def _damped(blocks: Float[Array, "n d d"], damping: Any) -> Float[Array, "n d d"]:
    eye = jnp.eye(blocks.shape[1], dtype=blocks.dtype)
    return blocks * (1.0 + damping * eye)[None]


def _point_factors(blocks: Float[Array, "n 3 3"]) -> tuple[Float[Array, "n 3 3"], Bool[Array, " n"]]:
    """Inverse factors of small blocks, zero along undetermined directions."""
    found = jax.vmap(factor, in_axes=-1, out_axes=-1)(jnp.moveaxis(blocks, 0, -1))
    lower = found.lower
    a, b, c = (jnp.where(found.lost[i], 0.0, 1.0 / lower[i, i]) for i in range(3))
    zero = jnp.zeros_like(a)
    ba, cb = -lower[1, 0] * a * b, -lower[2, 1] * b * c
    ca = -(lower[2, 0] * a + lower[2, 1] * ba) * c
    rows = jnp.stack([jnp.stack(row) for row in ((a, zero, zero), (ba, b, zero), (ca, cb, c))])
    return jnp.moveaxis(rows * found.scale[None], -1, 0), jnp.any(found.lost, axis=0)


def _reduced(cameras: Float[Array, "c 6 6"], gain: Float[Array, "m 3 6"], structure: Structure) -> Float[Array, "d d"]:
    """``U - W V^-1 W^T``: products of the observations of each pair, row by row of the tables."""
    padded = with_zero(gain)
    near, far = padded[structure.first], padded[structure.second]
    rows, members = structure.first.shape
    near, far = (part.reshape(rows, members * 3, 6) for part in (near, far))
    products = matmul(jnp.swapaxes(near, 1, 2), far)
    count = structure.block_row.shape[0]
    blocks = jax.ops.segment_sum(products, structure.block, count, indices_are_sorted=True)
    size, row, column = cameras.shape[0], structure.block_row, structure.block_column
    whole = jnp.zeros((size, size, 6, 6), cameras.dtype).at[row, column].set(blocks)
    other = jnp.where((row == column)[:, None, None], blocks, jnp.swapaxes(blocks, 1, 2))
    whole = whole.at[column, row].set(other)
    index = jnp.arange(size)
    whole = (-whole).at[index, index].add(cameras)
    return jnp.swapaxes(whole, 1, 2).reshape(6 * size, 6 * size)
