"""Pose graph optimization: poses from relative measurements, by nonlinear least squares."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxloc import _linalg
from jaxloc import _tree as tree
from jaxloc._jit import filter_jit
from jaxloc._linalg import matmul
from jaxloc.beliefs import validity
from jaxloc.solvers import Estimate, LevenbergMarquardt, Linearization, Problem, Quadratic, solve
from jaxloc.solvers.gauss_newton import Solver


class Edges(eqx.Module):
    """Edges of a pose graph: relative measurements between poses, padded to a fixed number.

    Attributes:
        first: number i of the pose that a measurement is made from.
        second: number j of the pose that is measured.
        T_first_second: measured pose of j in the frame of i, stacked; any group of `jaxloc.poses`.
        covariance: of each, in the tangent of the measured pose (right perturbation).
        valid: which edges there are.

    Example:
        >>> import jax, jax.numpy as jnp, jaxloc as jl
        >>> from jaxloc.slam.pose_graph import Edges
        >>> motions = jax.vmap(jl.poses.SE2)(jnp.ones(2), jnp.zeros(2), jnp.zeros(2))
        >>> len(Edges.chain(motions, 0.01 * jnp.eye(3)[None].repeat(2, axis=0)))
        2
    """

    first: Int[Array, " m"]
    second: Int[Array, " m"]
    T_first_second: Any
    covariance: Float[Array, "m d d"]
    valid: Bool[Array, " m"]

    @staticmethod
    def chain(motions: Any, covariance: Float[Array, "m d d"]) -> "Edges":
        """Odometry edges: a measurement from each pose to the next."""
        first = jnp.arange(covariance.shape[0], dtype=jnp.int32)
        return Edges(first, first + 1, motions, covariance, jnp.ones(first.shape, bool))

    def __len__(self) -> int:
        return self.first.shape[0]

    def join(self, other: "Edges") -> "Edges":
        """Concatenation with other edges."""
        return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), self, other)


class PoseGraph(Problem):
    """``sum_e rho(|r_e|^2)`` with ``r_e = S_e^(-1/2) log(Z_e^-1 T_i^-1 T_j)``; the state is all poses but the first.

    Attributes:
        fixed: the first pose, held fixed.
        first: of each edge.
        second: of each edge.
        measured: of each edge.
        whitener: inverse Cholesky factors of the covariances.
        valid: which edges there are.
        loss: robust kernel, on an edge's squared distance in sigmas.
    """

    fixed: Any
    first: Int[Array, " m"]
    second: Int[Array, " m"]
    measured: Any
    whitener: Float[Array, "m d d"]
    valid: Bool[Array, " m"]
    loss: Any = Quadratic()

    @staticmethod
    def of(edges: Edges, poses: Any, loss: Any) -> "PoseGraph":
        """Problem from edges and an initial value.

        Edges are masked that are empty, lead to poses that do not exist, or whose measurement is no pose or covariance.
        """
        count, dof = poses.batch_shape[0], edges.covariance.shape[-1]
        good = edges.valid & (edges.first >= 0) & (edges.second >= 0)
        good = good & (edges.first < count) & (edges.second < count) & (edges.first != edges.second)
        eye = jnp.eye(dof, dtype=edges.covariance.dtype)
        good = good & jax.vmap(_is_pose)(edges.T_first_second)
        good = good & jax.vmap(_is_definite)(jnp.where(good[:, None, None], edges.covariance, eye[None]))
        # Safe matrices in: a factorization that fails has no derivatives.
        known = jnp.where(good[:, None, None], edges.covariance, eye[None])
        lower, _ = jax.vmap(lambda matrix: _linalg.first_cholesky(matrix[None]))(known)
        whitener = jax.vmap(lambda matrix: _linalg.forward_substitution(matrix, eye))(lower)
        neutral = type(poses).identity(eye.dtype)
        measured = jax.vmap(lambda use, pose: _where(use, pose, neutral))(good, edges.T_first_second)
        first, second = (jnp.where(good, ends, 0) for ends in (edges.first, edges.second))
        return PoseGraph(_at(poses, 0), first, second, measured, whitener, good, loss)

    def _errors(self, state: Any) -> tuple[Any, Any, Float[Array, "m d"]]:
        """Poses at both ends of each edge, and what the measurement misses."""
        poses = jax.tree.map(lambda head, rest: jnp.concatenate([head[None], rest]), self.fixed, state)
        near, far = _at(poses, self.first), _at(poses, self.second)
        missed = jax.vmap(lambda z, a, b: (z.inverse() @ (a.inverse() @ b)).log())(self.measured, near, far)
        return near, far, jnp.where(self.valid[:, None], missed, 0.0)

    def residual(self, state: Any) -> Float[Array, "d m"]:
        """Whitened errors of the edges."""
        missed = self._errors(state)[2]
        return jnp.einsum("mij,mj->im", self.whitener, missed, precision="highest")

    def linearize(self, state: Any) -> Linearization:
        """In closed form: ``dr = S^(-1/2) Jr(r)^-1 (d_j - Ad(T_j^-1 T_i) d_i)``."""
        near, far, missed = self._errors(state)
        dof, count = missed.shape[1], state.batch_shape[0]
        group = type(self.fixed)
        by_second = matmul(self.whitener, jax.vmap(lambda r: group.left_jacobian_inverse(-r))(missed))
        by_second = jnp.where(self.valid[:, None, None], by_second, 0.0)
        by_first = -matmul(by_second, jax.vmap(lambda a, b: (b.inverse() @ a).adjoint())(near, far))
        edges = jnp.arange(missed.shape[0])
        jacobian = jnp.zeros((count + 1, dof, dof, missed.shape[0]), missed.dtype)
        # Axes: pose, its direction, component, edge.
        jacobian = jacobian.at[self.second, :, :, edges].add(jnp.swapaxes(by_second, 1, 2))
        jacobian = jacobian.at[self.first, :, :, edges].add(jnp.swapaxes(by_first, 1, 2))
        residual = jnp.einsum("mij,mj->im", self.whitener, missed, precision="highest")
        return Linearization(residual, jacobian[1:].reshape(count * dof, dof, -1))


@filter_jit
def optimize(
    poses: Any, edges: Edges, *, loss: Any = Quadratic(), solver: Solver = LevenbergMarquardt(), max_steps: int = 50
) -> Estimate:
    """Optimizes a pose graph; the first pose is fixed.

    Minimizes ``sum_e rho(|log(Z_e^-1 T_i^-1 T_j)|^2)`` in the metric of the covariances, with the Jacobian in closed
    form. The normal equations are **dense**: n poses of d directions cost memory of (n d)^2 numbers and time of (n d)^3
    a step, which suits up to a few hundred poses; longer graphs want a sparse factorization.

    Args:
        poses: initial value, stacked along "n"; any group of `jaxloc.poses`.
        edges: the measurements, some of them perhaps empty.
        loss: robust kernel, on an edge's distance in sigmas, against wrong loop closures.
        solver: of the iterations.
        max_steps: bound on their number.

    Returns:
        Estimate of all poses, the first with zero covariance. Its covariance is that of the stacked tangents, pose by
        pose ("n d" x "n d"). Not ok where edges do not tie every pose to the first one, or an initial pose is none.
        Derivatives by measurements and the first pose are those of the solution.

    Raises:
        ValueError: there are fewer than two poses, or covariances of another size than the poses' tangents.

    References:
        Lu and Milios, "Globally consistent range scan alignment for environment mapping", 1997; Grisetti et al., "A
        tutorial on graph-based SLAM", 2010; loop closure of floor mosaics [K-83].

    Example:
        >>> import jax, jax.numpy as jnp, jaxloc as jl
        >>> from jaxloc.slam import pose_graph
        >>> square = jax.vmap(jl.poses.SE2)(jnp.ones(4), jnp.zeros(4), jnp.full(4, jnp.pi / 2 + 0.02))
        >>> part = lambda which: jax.tree.map(lambda leaf: leaf[which], square)
        >>> noise = 0.01 * jnp.eye(3)[None].repeat(4, axis=0)
        >>> odometry = pose_graph.Edges.chain(part(slice(3)), noise[:3])
        >>> last, start = jnp.array([3]), jnp.array([0])
        >>> closure = pose_graph.Edges(last, start, part(slice(3, 4)), noise[3:], jnp.array([True]))
        >>> initial = jl.poses.trajectory.chain(jl.poses.SE2(0.0, 0.0, 0.0), odometry.T_first_second)
        >>> fit = pose_graph.optimize(initial, odometry.join(closure))
        >>> bool(fit.ok), round(float(fit.value.translation[2, 0]), 2)
        (True, 1.0)
    """
    count = poses.batch_shape[0] if len(poses.batch_shape) == 1 else 0
    if count < 2:
        raise ValueError(f"optimize: poses have stack shape {poses.batch_shape}; give at least two along one axis.")
    if edges.covariance.shape[-1] != poses.dof:
        raise ValueError(
            f"optimize: covariances of size {edges.covariance.shape[-1]} came with poses of {poses.dof} directions."
        )
    given = jax.vmap(_is_pose)(poses)
    poses = jax.vmap(tree.where)(given, poses, validity.neutral(poses))
    problem = PoseGraph.of(edges, poses, loss)
    fit = solve(problem, _at(poses, slice(1, None)), solver=solver, max_steps=max_steps)
    value = jax.tree.map(lambda head, rest: jnp.concatenate([head[None], rest]), problem.fixed, fit.value)
    pad = ((poses.dof, 0), (poses.dof, 0))
    covariance, information = jnp.pad(fit.covariance, pad), jnp.pad(fit.information, pad)
    ok = fit.ok & jnp.all(given)
    value = tree.detach_unless(ok, value)
    return Estimate(value, covariance, fit.cost, ok, fit.num_steps, fit.status, information)


def marginals(fit: Estimate) -> Float[Array, "n d d"]:
    """Marginal covariance of each pose.

    Args:
        fit: what `optimize` returned.

    Returns:
        The blocks along the diagonal.

    Example:
        >>> import jax, jax.numpy as jnp, jaxloc as jl
        >>> from jaxloc.slam import pose_graph
        >>> motion = jax.vmap(jl.poses.SE2)(jnp.ones(1), jnp.zeros(1), jnp.zeros(1))
        >>> initial = jl.poses.trajectory.chain(jl.poses.SE2(0.0, 0.0, 0.0), motion)
        >>> fit = pose_graph.optimize(initial, pose_graph.Edges.chain(motion, 0.04 * jnp.eye(3)[None]))
        >>> [round(float(x), 2) for x in pose_graph.marginals(fit)[1].diagonal()]
        [0.04, 0.04, 0.04]
    """
    count, dof = fit.value.batch_shape[0], fit.value.dof
    blocks = fit.covariance.reshape(count, dof, count, dof)
    each = jnp.arange(count)
    return blocks[each, :, each, :]


def _is_pose(pose: Any) -> Bool[Array, ""]:
    """Whether a pose is finite, within range, and its rotation is one."""
    pose = lax.stop_gradient(pose)
    rotation = getattr(pose, "rotation", pose)
    turned = rotation.compose(rotation.inverse()).matrix()
    return tree.within_range(pose) & jnp.all(jnp.abs(turned - jnp.eye(turned.shape[0], dtype=turned.dtype)) < 0.1)


def _is_definite(covariance: Float[Array, "d d"]) -> Bool[Array, ""]:
    """Whether a covariance has an inverse root within the range of numbers; without derivatives."""
    lower, definite = _linalg.first_cholesky(lax.stop_gradient(covariance)[None])
    return definite & tree.within_range((lower, 1.0 / jnp.diagonal(lower)))


def _at(poses: Any, index: Any) -> Any:
    return jax.tree.map(lambda leaf: leaf[index], poses)


def _where(use: Bool[Array, ""], pose: Any, other: Any) -> Any:
    return jax.tree.map(lambda a, b: jnp.where(use, a, b.astype(a.dtype)), pose, other)
