"""Closed-form alignment of corresponding points, in the plane and in space.

The rotation of space is the eigenvector of Horn's 4x4 matrix to its largest eigenvalue. No derivative passes through
the eigenvalue problem, where equal eigenvalues would make it infinite: derivatives are those of the minimum of a
least-squares problem.

References:
    Horn, "Closed-form solution of absolute orientation using unit quaternions", JOSA A 1987 [K-48].
    Umeyama, "Least-squares estimation of transformation parameters between two point patterns", T-PAMI 1991.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxloc import _linalg
from jaxloc import _tree as tree
from jaxloc._jit import filter_jit
from jaxloc._linalg import matmul
from jaxloc.beliefs.validity import positive
from jaxloc.poses import SE2, SE3, SO2, SO3
from jaxloc.solvers.cholesky import rank_tolerance
from jaxloc.solvers.estimate import Estimate, Status, guarded
from jaxloc.solvers.implicit_gradient import attach_gradient
from jaxloc.solvers.least_squares import StationaryPoint, covariance
from jaxloc.solvers.problem import Problem, normal_equations
from jaxloc.solvers.robust_kernels import Quadratic


class Similarity(eqx.Module):
    """A similarity transform: ``x_a = scale R x_b + t``.

    Attributes:
        pose: rotation and translation.
        scale: scale factor.
    """

    pose: SE2 | SE3
    scale: Float[Array, ""]

    def apply(self, points: Float[Array, "n k"]) -> Float[Array, "n k"]:
        """Points of the inner frame in the outer frame."""
        return self.pose.apply(self.scale * points)


class PointAlignment(Problem):
    """Corresponding points of two frames; the state is a `SE2`, `SE3` or `Similarity` ``T_target_source``.

    Attributes:
        source: "n k", m; finite everywhere.
        target: "n k", m; finite everywhere.
        whitening: one over the standard deviation of a coordinate of the difference; zero for invalid points.
        loss: robust kernel over the k components of an item.
    """

    source: Float[Array, "n k"]
    target: Float[Array, "n k"]
    whitening: Float[Array, " n"]
    loss: Any = Quadratic()

    def residual(self, state: Any) -> Float[Array, "k n"]:
        """Whitened differences."""
        return ((state.apply(self.source) - self.target) * self.whitening[:, None]).T


@filter_jit
def align_points(
    source: Float[Array, "n k"],
    target: Float[Array, "n k"],
    *,
    weights: Float[Array, " n"] | None = None,
    valid: Bool[Array, " n"] | None = None,
    sigma: Any = 1.0,
) -> Estimate:
    """Rigid motion that aligns corresponding points, in closed form.

    Minimizes ``sum w_i |T s_i - t_i|^2 / (2 sigma^2)`` over the pose ``T = T_target_source``.

    Args:
        source: "n 2" or "n 3", m.
        target: the corresponding points, m.
        weights: relative information of each pair, one by default; pairs of weight zero are invalid.
        valid: mask of the pairs; values of invalid pairs, NaN included, have no influence.
        sigma: standard deviation of a coordinate of the difference at weight one, m.

    Returns:
        Estimate of `SE2` or `SE3`. ``ok`` is False when points coincide or, in space, lie on a line.

    Raises:
        ValueError: if the points have neither 2 nor 3 coordinates.

    References:
        Horn 1987, section 4 [K-48].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> corner = jnp.array([[0.0, 0.0], [2.0, 0.0], [0.0, 1.0]])
        >>> fit = jl.solvers.align_points(corner, jl.poses.SE2(1.0, 2.0, 0.5).apply(corner))
        >>> bool(fit.ok), round(float(fit.value.theta), 3)
        (True, 0.5)
    """
    sigma = jnp.asarray(sigma, source.dtype)
    return guarded(positive(sigma), _align, source, target, weights, valid, sigma)


def _align(source: Array, target: Array, weights: Any, valid: Any, sigma: Array) -> Estimate:
    problem, weight = _problem(source, target, weights, valid, sigma)
    value, _, determined = _umeyama(problem.source, problem.target, weight)
    return _estimate(problem, value, determined)


@filter_jit
def align_scaled_points(
    source: Float[Array, "n k"],
    target: Float[Array, "n k"],
    *,
    weights: Float[Array, " n"] | None = None,
    valid: Bool[Array, " n"] | None = None,
    sigma: Any = 1.0,
) -> Estimate:
    """Rigid motion and scale that align corresponding points, in closed form.

    Minimizes ``sum w_i |scale R s_i + t - t_i|^2 / (2 sigma^2)``: for instance to align monocular
    trajectories, whose scale is free.

    Args:
        source: "n 2" or "n 3", m or any unit.
        target: the corresponding points, m.
        weights: relative information of each pair, one by default; pairs of weight zero are invalid.
        valid: mask of the pairs; values of invalid pairs, NaN included, have no influence.
        sigma: standard deviation of a coordinate of the difference at weight one, m.

    Returns:
        Estimate of a `Similarity`; the scale is the last entry of the tangent.

    Raises:
        ValueError: if the points have neither 2 nor 3 coordinates.

    References:
        Umeyama 1991, eq. 40-42.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> corner = jnp.array([[0.0, 0.0], [2.0, 0.0], [0.0, 1.0]])
        >>> fit = jl.solvers.align_scaled_points(corner, 3.0 * jl.poses.SE2(1.0, 2.0, 0.5).apply(corner))
        >>> bool(fit.ok), round(float(fit.value.scale), 3)
        (True, 3.0)
    """
    sigma = jnp.asarray(sigma, source.dtype)
    return guarded(positive(sigma), _align_scaled, source, target, weights, valid, sigma)


def _align_scaled(source: Array, target: Array, weights: Any, valid: Any, sigma: Array) -> Estimate:
    problem, weight = _problem(source, target, weights, valid, sigma)
    pose, scale, determined = _umeyama(problem.source, problem.target, weight)
    center = _centroid(problem.source, weight)
    # The rigid translation aligns the centroids; the scaled one has to do so as well.
    shift = (1.0 - scale) * pose.rotation.apply(center[None])[0]
    moved = eqx.tree_at(lambda p: p.translation, pose, pose.translation + shift)
    return _estimate(problem, Similarity(moved, scale), determined)


def _problem(source: Array, target: Array, weights: Any, valid: Any, sigma: Any) -> tuple[PointAlignment, Array]:
    """The problem with invalid values replaced, and weights without derivatives for the closed form."""
    if source.shape[1] not in {2, 3}:
        raise ValueError(f"Points have 2 or 3 coordinates; these have {source.shape[1]}.")
    usable = jnp.all(jnp.isfinite(source), axis=1) & jnp.all(jnp.isfinite(target), axis=1)
    weight = jnp.ones(source.shape[:1], source.dtype) if weights is None else weights
    usable = usable & jnp.isfinite(weight) & (weight > 0)
    usable = usable if valid is None else usable & valid
    root = jnp.where(usable, jnp.sqrt(jnp.where(usable, weight, 1.0)), 0.0) / jnp.asarray(sigma, source.dtype)
    source, target = jnp.where(usable[:, None], source, 0.0), jnp.where(usable[:, None], target, 0.0)
    return PointAlignment(source, target, root), jax.lax.stop_gradient(jnp.where(usable, weight, 0.0))


def _centroid(points: Float[Array, "n k"], weight: Float[Array, " n"]) -> Float[Array, " k"]:
    total = jnp.sum(weight)
    return matmul(weight, jax.lax.stop_gradient(points)) / jnp.where(total > 0, total, 1.0)


def _umeyama(
    source: Float[Array, "n k"], target: Float[Array, "n k"], weight: Float[Array, " n"]
) -> tuple[SE2 | SE3, Float[Array, ""], Bool[Array, ""]]:
    """Pose, scale, and whether they are determined; without derivatives."""
    source, target = jax.lax.stop_gradient((source, target))
    from_center, to_center = _centroid(source, weight), _centroid(target, weight)
    counted = jnp.where(weight > 0, 1.0, 0.0).astype(source.dtype)[:, None]
    s, t = (source - from_center[None, :]) * counted, (target - to_center[None, :]) * counted
    variance_s, variance_t = (jnp.sum(weight[:, None] * c**2) for c in (s, t))
    cross = matmul((s * weight[:, None]).T, t)
    rotation, gap = (_planar_rotation if source.shape[1] == 2 else _horn)(cross)
    moved = rotation.apply(s)
    product = jnp.sum(weight[:, None] * moved * t)
    scale = jnp.where(product > 0, product, 1.0) / jnp.where((product > 0) & (variance_s > 0), variance_s, 1.0)
    # Variances at rounding level count as zero.
    rounding = 8.0 * float(jnp.finfo(source.dtype).eps)
    floor = [jnp.sum(weight) * (rounding * jnp.max(jnp.abs(c), initial=0.0)) ** 2 for c in (source, target)]
    size = jnp.sqrt(variance_s) * jnp.sqrt(variance_t)
    determined = (variance_s > floor[0]) & (variance_t > floor[1]) & (gap > rank_tolerance(source.dtype) * size)
    translation = to_center - rotation.apply(from_center[None])[0]
    pose = SE2.from_parts(rotation, translation) if source.shape[1] == 2 else SE3(rotation, translation)
    return pose, scale, determined


def _planar_rotation(cross: Float[Array, "2 2"]) -> tuple[SO2, Float[Array, ""]]:
    """The planar rotation, and the curvature of the cost at it."""
    cos, sin = cross[0, 0] + cross[1, 1], cross[0, 1] - cross[1, 0]
    length = jnp.sqrt(cos**2 + sin**2)
    known = length > 0
    length = jnp.where(known, length, 1.0)
    return SO2(jnp.where(known, cos / length, 1.0), sin / length), jnp.where(known, length, 0.0)


def _horn(cross: Float[Array, "3 3"]) -> tuple[SO3, Float[Array, ""]]:
    """The rotation in space, and the gap between the two largest eigenvalues: zero for collinear points."""
    trace = jnp.trace(cross)
    symmetric = cross + cross.T - trace * jnp.eye(3, dtype=cross.dtype)
    axis = jnp.stack([cross[1, 2] - cross[2, 1], cross[2, 0] - cross[0, 2], cross[0, 1] - cross[1, 0]])
    top = jnp.concatenate([trace[None], axis])[None, :]
    matrix = jnp.concatenate([top, jnp.concatenate([axis[:, None], symmetric], axis=1)])
    values, vectors = _linalg.eigh(matrix)
    return SO3.from_quaternion(vectors[:, 3]), values[3] - values[2]


def _estimate(problem: PointAlignment, found: Any, determined: Bool[Array, ""]) -> Estimate:
    problem = tree.detach_unless(determined, problem)
    value = attach_gradient(found, StationaryPoint(problem), determined)
    normal = normal_equations(problem, value)
    status = jnp.where(determined, int(Status.CONVERGED), int(Status.RANK_DEFICIENT)).astype(int)
    noise = covariance(problem, value, normal, determined)
    return Estimate(value, noise, normal.cost, determined, jnp.zeros((), int), status, normal.hessian)
