"""Homographies from point correspondences: closed forms, and a robust estimate with covariance.

Closed forms have no derivatives; refined estimates have those of their minimum.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from jaxloc import _linalg
from jaxloc._arguments import checked
from jaxloc._jit import filter_jit
from jaxloc._linalg import matmul
from jaxloc._tree import detach_unless
from jaxloc.images import Homography
from jaxloc.poses import SE3, Direction
from jaxloc.sensors import Pinhole
from jaxloc.solvers import Estimate, LevenbergMarquardt, Loss, Problem, Quadratic, RobustEstimate, Tukey, ransac, solve

# Root of the 99 % quantile of chi-square with two degrees of freedom.
_GATE = 3.035
# Scale of Tukey's kernel on two components for 95 % efficiency.
_TUKEY = 5.12
_SAMPLE = 4


@filter_jit
@checked
def plane_homography(
    first: Pinhole, second: Pinhole, T_first_second: SE3, normal: Direction, distance: Float[Array, ""]
) -> Homography:
    """Homography induced by a plane ``n . x = d``, from pixels of the first camera to those of the second.

    ``H = K2 R^T (I - t n^T / d) K1^-1`` with ``T_first_second = (R, t)``; pixels are undistorted.

    Args:
        first: the first camera.
        second: the second camera.
        T_first_second: pose of the second camera in the frame of the first.
        normal: of the plane, frame of the first camera, away from it.
        distance: of the plane from the first camera, m.

    Returns:
        The homography.

    References:
        Hartley and Zisserman, *Multiple View Geometry*, 2004, result 13.1 [K-17].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> camera = jl.sensors.Pinhole(100.0, 100.0, 50.0, 50.0)
        >>> step = jl.poses.SE3.from_euler(jnp.array([0.1, 0.0, 0.0]), 0.0, 0.0, 0.0)
        >>> wall = jl.poses.Direction(jnp.array([0.0, 0.0, 1.0]))
        >>> found = jl.multiview.homography.plane_homography(camera, camera, step, wall, jnp.array(2.0))
        >>> [round(float(x), 2) for x in found.apply(jnp.array([[50.0, 50.0]]))[0]]
        [45.0, 50.0]
    """
    shift = T_first_second.translation[:, None] * normal.vector[None, :] / distance
    moved = matmul(T_first_second.rotation.matrix().T, jnp.eye(3, dtype=shift.dtype) - shift)
    return Homography.from_matrix(matmul(second.matrix(), matmul(moved, _inverse(first))))


@checked
def direct_linear_transform(
    points: Float[Array, "2 m"], pixels: Float[Array, "2 m"], valid: Bool[Array, " m"]
) -> Float[Array, "3 3"]:
    """Normalized direct linear transform: homography from points of a plane to pixels, without derivatives.

    Args:
        points: of the plane, any unit; finite.
        pixels: the corresponding pixels; finite.
        valid: pairs that are used.

    Returns:
        Matrix of unit Frobenius norm; finite, but meaningless with fewer than four valid points.

    References:
        Hartley and Zisserman, *Multiple View Geometry*, 2004, algorithm 4.2.
    """
    points, pixels = jax.lax.stop_gradient((points, pixels))
    to_points, (x, y) = normalizer(points, valid)
    to_pixels, (u, v) = normalizer(pixels, valid)
    one, zero = valid.astype(u.dtype), jnp.zeros_like(u)
    rows_u = jnp.stack([x, y, one, zero, zero, zero, -u * x, -u * y, -u], axis=1)
    rows_v = jnp.stack([zero, zero, zero, x, y, one, -v * x, -v * y, -v], axis=1)
    # Four points give eight rows; zeros up to nine keep the null vector in the thin decomposition.
    missing = jnp.zeros((max(9 - 2 * points.shape[1], 1), 9), u.dtype)
    rows = jnp.concatenate([rows_u, rows_v, missing])
    _, _, right = _linalg.svd(rows)
    matrix = matmul(_denormalizer(to_pixels), matmul(right[8].reshape(3, 3), to_points))
    norm = jnp.sqrt(jnp.sum(matrix * matrix))
    good = jnp.isfinite(norm) & (norm > 0)
    return jnp.where(good, matrix / jnp.where(good, norm, 1.0), jnp.eye(3, dtype=u.dtype))


@checked
def normalizer(
    points: Float[Array, "2 m"], valid: Bool[Array, " m"]
) -> tuple[Float[Array, "3 3"], Float[Array, "2 m"]]:
    """Hartley normalization: a similarity to zero mean and mean distance one, and the mapped points; zero if masked.

    References:
        Hartley, "In defense of the eight-point algorithm", T-PAMI 1997 [R-49].
    """
    count = jnp.maximum(jnp.sum(valid), 1).astype(points.dtype)
    mean = jnp.sum(jnp.where(valid[None, :], points, 0.0), axis=1) / count
    centered = jnp.where(valid[None, :], points - mean[:, None], 0.0)
    squared = jnp.sum(centered**2) / count
    scale = jnp.sqrt(jnp.where(squared > 0, squared, 1.0))
    zero, one = jnp.zeros_like(scale), jnp.ones_like(scale)
    rows = [[1.0 / scale, zero, -mean[0] / scale], [zero, 1.0 / scale, -mean[1] / scale], [zero, zero, one]]
    return jnp.stack([jnp.stack(row) for row in rows]), centered / scale


def _denormalizer(similarity: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    scale = similarity[0, 0]
    zero, one = jnp.zeros_like(scale), jnp.ones_like(scale)
    rows = [[1.0 / scale, zero, -similarity[0, 2] / scale], [zero, 1.0 / scale, -similarity[1, 2] / scale]]
    return jnp.stack([jnp.stack(row) for row in [*rows, [zero, zero, one]]])


def _inverse(camera: Pinhole) -> Float[Array, "3 3"]:
    """Inverse of a camera matrix."""
    one, zero = jnp.ones_like(camera.fx), jnp.zeros_like(camera.fx)
    x, y = 1.0 / camera.fx, 1.0 / camera.fy
    tilt = -camera.skew * x * y
    rows = [[x, tilt, -camera.cx * x - tilt * camera.cy], [zero, y, -camera.cy * y], [zero, zero, one]]
    return jnp.stack([jnp.stack(row) for row in rows])


@filter_jit
@checked
def four_points(first: Float[Array, "4 2"], second: Float[Array, "4 2"]) -> Homography:
    """Homography of four point pairs: exact, smooth, without linear solver.

    Four points are a frame of the projective plane; the homography is the change from one frame to the other.

    Args:
        first: four points, no three on a line.
        second: the corresponding points.

    Returns:
        The homography; finite, but meaningless where three points lie on a line.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> square = jnp.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
        >>> jl.multiview.homography.four_points(square, 2.0 * square).apply(jnp.array([[0.5, 0.25]])).round(4).tolist()
        [[1.0, 0.5]]
    """
    to_first, to_second = _frame(first), _frame(second)
    matrix = matmul(to_second, _adjugate(to_first))
    largest = jnp.max(jnp.abs(matrix))
    good = jnp.isfinite(largest) & (largest > 0)
    matrix = jnp.where(good, matrix, jnp.eye(3, dtype=matrix.dtype))
    return Homography.from_matrix(matrix / jnp.where(good, largest, 1.0))


def _frame(points: Float[Array, "4 2"]) -> Float[Array, "3 3"]:
    """Matrix that maps the axes and their sum to four points, up to scale."""
    p = jnp.concatenate([points, jnp.ones_like(points[:, :1])], axis=1)
    weights = jnp.sum(_adjugate(p[:3].T) * p[3][None, :], axis=1)
    return p[:3].T * weights[None, :]


def _adjugate(m: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    a, b, c = m[:, 0], m[:, 1], m[:, 2]
    return jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)])


class TransferError(Problem):
    """Least-squares problem of corresponding points of a plane in two noisy images; the state is the `Homography`.

    The error ``e = x2 - H(x1)`` has, to first order, the covariance ``s^2 (I + J J^T)`` with the derivative J of the
    map at ``x1``; it is whitened by that: Sampson's error.

    Attributes:
        first: "2 n", px; finite everywhere.
        second: "2 n", px; finite everywhere.
        sigma: standard deviation of a coordinate in either image, px.
        valid: pairs that are used.
        loss: robust kernel over the two components.

    References:
        Hartley and Zisserman, *Multiple View Geometry*, 2004, section 4.2.6.
    """

    first: Float[Array, "2 n"]
    second: Float[Array, "2 n"]
    sigma: Float[Array, ""]
    valid: Bool[Array, " n"]
    loss: Any = Quadratic()

    def residual(self, state: Homography) -> Float[Array, "2 n"]:
        """Whitened errors; points behind the horizon have a large constant error."""
        return transfer_error(state.homogeneous, self.first, self.second, self.sigma, self.valid)


@checked
def transfer_error(
    matrix: Float[Array, "3 3"],
    first: Float[Array, "2 n"],
    second: Float[Array, "2 n"],
    sigma: Any,
    valid: Bool[Array, " n"],
) -> Float[Array, "2 n"]:
    """Whitened transfer errors for any matrix: 1000 sigmas behind the horizon, zero where masked."""
    # Written out, so that many hypotheses become one loop over the points.
    x, y, w = (row[0] * first[0] + row[1] * first[1] + row[2] for row in matrix)
    # The sign of the determinant is one: points of the plane that both cameras see have positive w.
    # Near the horizon the sign is rounding, and squared coordinates overflow.
    parts = jnp.abs(matrix[2, 0] * first[0]) + jnp.abs(matrix[2, 1] * first[1]) + jnp.abs(matrix[2, 2])
    in_front = valid & (w > float(jnp.finfo(w.dtype).eps) ** 0.5 * parts)
    inverse = 1.0 / jnp.where(in_front, w, 1.0)
    u, v = jnp.where(in_front, x, 0.0) * inverse, jnp.where(in_front, y, 0.0) * inverse
    by_x = [(matrix[0, i] - u * matrix[2, i]) * inverse for i in range(2)]
    by_y = [(matrix[1, i] - v * matrix[2, i]) * inverse for i in range(2)]
    s00 = 1.0 + by_x[0] ** 2 + by_x[1] ** 2
    s01 = by_x[0] * by_y[0] + by_x[1] * by_y[1]
    s11 = 1.0 + by_y[0] ** 2 + by_y[1] ** 2
    e0, e1 = second[0] - u, second[1] - v
    root = jnp.sqrt(s00)
    lower = s01 / s00
    rest = jnp.sqrt(jnp.maximum(s11 - s01 * lower, 1.0 / s00))
    whitened = jnp.stack([e0 / root, (e1 - lower * e0) / rest]) / sigma
    return jnp.where(in_front[None, :], whitened, jnp.where(valid, 1e3, 0.0).astype(whitened.dtype)[None, :])


def _fit_sample(sample: tuple[Array, Array, Array]) -> Homography:
    return four_points(sample[0], sample[1])


def _distance(model: Homography, data: tuple[Array, Array, Array]) -> Float[Array, " n"]:
    first, second, sigma = data
    valid = jnp.ones(first.shape[:1], bool)
    return jnp.sqrt(jnp.sum(transfer_error(model.homogeneous, first.T, second.T, sigma[0], valid) ** 2, axis=0))


@filter_jit
@checked
def estimate_homography(
    first: Float[Array, "n 2"],
    second: Float[Array, "n 2"],
    *,
    key: Key[Array, ""],
    sigma: Any = 1.0,
    valid: Bool[Array, " n"] | None = None,
    hypotheses: int = 128,
    loss: Loss | None = None,
) -> RobustEstimate:
    """Homography between two images of a plane (or of a rotating camera), from correspondences with outliers.

    RANSAC over samples of four points (MSAC on the whitened transfer error); the best model is refitted to its inliers
    and then refined on SL(3) under a robust kernel over all correspondences.

    Args:
        first: points of the first image, px.
        second: the corresponding points of the second, px.
        key: random key.
        sigma: standard deviation of a coordinate in either image, px.
        valid: correspondences that are used; non-finite ones never are.
        hypotheses: number of samples; static.
        loss: kernel of the refinement, in sigmas; Tukey's of 95 % efficiency if None.

    Returns:
        Estimate of `Homography`, and which pairs agree with it. ``ok`` is False when no homography explains more than
        four points, or points lie on a line.

    Raises:
        ValueError: fewer than four correspondences.

    References:
        Fischler and Bolles 1981 [K-60]; Torr and Zisserman, "MLESAC", CVIU 2000; Hartley and Zisserman 2004, 4.8.

    Example:
        >>> import jax, jax.numpy as jnp, jaxloc as jl
        >>> points = jax.random.uniform(jax.random.key(0), (30, 2), maxval=100.0)
        >>> moved = points.at[:8].add(30.0) + jnp.array([[5.0, 2.0]])
        >>> found = jl.multiview.homography.estimate_homography(points, moved, key=jax.random.key(1))
        >>> bool(found.ok), [round(float(x), 1) for x in found.value.apply(jnp.array([[50.0, 50.0]]))[0]]
        (True, [55.0, 52.0])
    """
    finite = jnp.all(jnp.isfinite(first), axis=1) & jnp.all(jnp.isfinite(second), axis=1)
    valid = finite if valid is None else valid & finite
    first, second = jnp.where(valid[:, None], first, 0.0), jnp.where(valid[:, None], second, 0.0)
    sigma = jnp.asarray(sigma, first.dtype)
    data = jax.lax.stop_gradient((first, second, jnp.broadcast_to(sigma, first.shape[:1])))
    options = {"sample_size": _SAMPLE, "threshold": _GATE, "hypotheses": hypotheses}
    found = ransac(data, _fit_sample, _distance, **options, key=key, valid=valid)
    initial = _refit(found.model, data, found.inliers, valid)
    loss = Tukey(jnp.asarray(_TUKEY, first.dtype)) if loss is None else loss
    fit = solve(TransferError(first.T, second.T, sigma, valid, loss), initial, solver=LevenbergMarquardt())
    inliers = valid & (_distance(jax.lax.stop_gradient(fit.value), data) < _GATE)
    return _validate(fit, found.ok & (jnp.sum(inliers) > _SAMPLE), inliers)


def _refit(model: Homography, data: Any, inliers: Array, valid: Array) -> Homography:
    """The model refitted to its inliers, if that does not lose inliers."""
    first, second, _ = data
    again = Homography.from_matrix(direct_linear_transform(first.T, second.T, inliers))
    better = jnp.sum(valid & (_distance(again, data) < _GATE)) >= jnp.sum(inliers)
    return Homography(jnp.where(better, again.homogeneous, model.homogeneous))


def _validate(fit: Estimate, condition: Bool[Array, ""], inliers: Bool[Array, " n"]) -> RobustEstimate:
    ok = fit.ok & condition
    return RobustEstimate(eqx.tree_at(lambda e: (e.value, e.ok), fit, (detach_unless(ok, fit.value), ok)), inliers)
