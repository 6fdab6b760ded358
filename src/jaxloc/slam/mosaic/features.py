"""Feature-based registration: squares found by correlation, and the pose from their positions."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxloc._jit import filter_jit
from jaxloc._linalg import matmul
from jaxloc.alignment.correlation import Window, search
from jaxloc.images.interpolation import Bilinear, sample_components
from jaxloc.images.warps import Translation
from jaxloc.poses import SE2
from jaxloc.slam.mosaic.view import Patch
from jaxloc.solvers import Estimate, GemanMcClure, Linearization, Problem, Quadratic, solve


@filter_jit
def feature_jacobian(T_i_j: SE2, points_j: Float[Array, "n 2"]) -> Float[Array, "n 2 3"]:
    """How features of frame j move in frame i with the parameters (a_j, b_j, theta_j) of the pose between them.

    ``[da_k, db_k] = [[1, 0, -(b_k - b_j)], [0, 1, a_k - a_j]] [da_j, db_j, dtheta_j]``: the first two rows of the
    compound-left pose Jacobian; features have no heading of their own. (Kelly's slide lacks the dtheta_j.)

    Args:
        T_i_j: the pose: position (a_j, b_j) and heading theta_j of frame j in frame i.
        points_j: "n 2", in frame j, m.

    Returns:
        One 2x3 matrix a feature; the perturbations add to a, b and theta (see `poses.compound`).

    References:
        A. Kelly, *Mobile Robotics*, 9.2.4.3.2 [K-85], with the erratum.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> feature_jacobian(jl.poses.SE2(5.0, 6.0, 0.0), jnp.array([[2.0, 3.0]]))[0].tolist()
        [[1.0, 0.0, -3.0], [0.0, 1.0, 2.0]]
    """
    offset = matmul(points_j, T_i_j.rotation.matrix().T)
    one, zero = jnp.ones_like(offset[:, 0]), jnp.zeros_like(offset[:, 0])
    rows = ((one, zero, -offset[:, 1]), (zero, one, offset[:, 0]))
    return jnp.stack([jnp.stack(row, axis=1) for row in rows], axis=1)


class FeaturePairs(Problem):
    """Positions of features in two frames; the state is ``T_i_j``.

    Attributes:
        points_i: "2 n", frame i, m.
        points_j: "2 n", frame j, m.
        sigma: standard deviation of each pair's difference along each axis, m.
        valid: which pairs count.
        loss: robust kernel, in sigmas.
    """

    points_i: Float[Array, "2 n"]
    points_j: Float[Array, "2 n"]
    sigma: Float[Array, " n"]
    valid: Bool[Array, " n"]
    loss: Any = Quadratic()

    def residual(self, state: SE2) -> Float[Array, "2 n"]:
        """Whitened differences in frame i."""
        predicted = matmul(state.rotation.matrix(), self.points_j) + state.translation[:, None]
        return jnp.where(self.valid[None], (predicted - self.points_i) / self.sigma[None], 0.0)

    def linearize(self, state: SE2) -> Linearization:
        """By `feature_jacobian`, turned from parameters to the tangent."""
        one = jnp.ones((1, 1), self.points_j.dtype)
        to_parameters = jax.scipy.linalg.block_diag(state.rotation.matrix(), one)
        by_feature = matmul(feature_jacobian(state, self.points_j.T), to_parameters)
        jacobian = jnp.transpose(by_feature, (2, 1, 0)) / self.sigma[None, None]
        return Linearization(self.residual(state), jnp.where(self.valid[None, None], jacobian, 0.0))


@filter_jit
def pose_from_features(
    points_i: Float[Array, "n 2"],
    points_j: Float[Array, "n 2"],
    initial: SE2,
    *,
    sigma: Float[Array, " n"] | Any = 1e-4,
    valid: Bool[Array, " n"] | None = None,
    loss: Any = Quadratic(),
) -> Estimate:
    """The pose between two frames from positions of the same features in both.

    Minimizes ``sum_k rho(|T_i_j p_jk - p_ik|^2 / sigma_k^2)``.

    Args:
        points_i: "n 2", frame i, m.
        points_j: "n 2", frame j, m.
        initial: initial value of ``T_i_j``.
        sigma: standard deviation of a pair's difference along each axis, m; one, or one a pair.
        valid: which pairs count; all by default.
        loss: robust kernel, in sigmas.

    Returns:
        Estimate of ``T_i_j``; not ok for fewer than two features.

    References:
        [K-85]; Horn's closed form is its oracle.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> points, truth = jnp.array([[0.0, 0.0], [0.1, 0.0], [0.0, 0.2]]), jl.poses.SE2(0.02, 0.01, 0.3)
        >>> found = pose_from_features(truth.apply(points), points, jl.poses.SE2(0.0, 0.0, 0.0))
        >>> bool(found.ok), round(float(found.value.theta), 3)
        (True, 0.3)
    """
    valid = jnp.ones(points_i.shape[0], bool) if valid is None else valid
    finite = jnp.all(jnp.isfinite(points_i) & jnp.isfinite(points_j), axis=1) & valid
    sigma = jnp.broadcast_to(jnp.asarray(sigma, points_i.dtype), finite.shape)
    first, second = (jnp.where(finite[:, None], points, 0.0).T for points in (points_i, points_j))
    return solve(FeaturePairs(first, second, jnp.where(finite, sigma, 1.0), finite, loss), initial)


class Squares(eqx.Module):
    """Layout of the square templates and their search range.

    Attributes:
        size: edge of a square, px.
        across: squares along each axis of the patch.
        reach: how far a square may lie from where it is predicted, px.
    """

    size: int = eqx.field(static=True, default=33)
    across: int = eqx.field(static=True, default=4)
    reach: int = eqx.field(static=True, default=24)


@filter_jit
def register_squares(first: Patch, second: Patch, predicted: SE2, *, squares: Squares = Squares()) -> Estimate:
    """Estimates the pose between two cameras over a floor from squares of the second patch, matched in the first.

    The first patch is turned to the predicted heading; each square is searched in it by zero-mean correlation, whatever
    the exposure; a robust fit of the pose finds the inliers. The initial value may be off by `Squares.reach`, where
    the derivatives that `register` follows may lead nowhere; its result starts that one.

    Args:
        first: the reference.
        second: the piece that is laid upon it; of the same resolution.
        predicted: initial value of ``T_first_second``.
        squares: which.

    Returns:
        Estimate of ``T_first_second``; not ok where fewer than a quarter of the squares agree.

    Raises:
        ValueError: the patch is too small for the squares.

    References:
        Patches correlated with the predicted mosaic [K-80, K-24, K-85].
    """
    size, reach, shape = squares.size, squares.reach, second.raster.shape
    room = [(length - size - 2 * reach) / max(squares.across - 1, 1) for length in shape]
    if min(room) < 1:
        raise ValueError(
            f"register_squares: patches of {shape} px hold no {squares.across} squares of {size} px that may "
            f"move by {reach} px along an axis; ask for smaller ones."
        )
    turned = _resampled(first, second, predicted)
    dtype = second.values.dtype
    steps = jnp.arange(squares.across, dtype=dtype)
    rows, columns = jnp.meshgrid(*(jnp.round(reach + step * steps) for step in room), indexing="ij")
    corners = jnp.stack([columns.reshape(-1), rows.reshape(-1)], axis=1)

    def find(corner: Float[Array, "2"]) -> tuple[Float[Array, "2"], Bool[Array, ""]]:
        start = corner[::-1].astype(jnp.int32)
        template = jax.lax.dynamic_slice(second.with_gaps(), (start[0], start[1]), (size, size))
        full = jnp.all(jnp.isfinite(template))
        template = jnp.where(full, template, 0.0)
        window = Window.around(Translation(corner), (size, size), reach=reach)
        found = search(turned, template, window)
        return found.value.translation - corner, found.ok & full

    shifts, ok = jax.vmap(find)(corners)
    middles = corners + 0.5 * (size - 1)
    points_j = second.raster.to_meters(middles)
    points_i = predicted.apply(second.raster.to_meters(middles + jnp.where(ok[:, None], shifts, 0.0)))
    sigma = 0.3 * second.raster.resolution
    rough = pose_from_features(points_i, points_j, predicted, sigma=20.0 * sigma, valid=ok, loss=GemanMcClure(3.0))
    start = jax.tree.map(jax.lax.stop_gradient, rough.value)
    left = jnp.sum((start.apply(points_j) - points_i) ** 2, axis=1)
    agree = ok & (left < (10.0 * sigma) ** 2)
    found = pose_from_features(points_i, points_j, start, sigma=sigma, valid=agree)
    enough = jnp.sum(agree) >= max(3, squares.across**2 // 4)
    return eqx.tree_at(lambda e: e.ok, found, found.ok & enough)


def _resampled(first: Patch, second: Patch, T_first_second: SE2) -> Float[Array, "p q"]:
    """The first patch on the raster of the second, NaN where unknown."""
    rows, columns = second.raster.shape
    axes = (jnp.arange(length, dtype=second.values.dtype) for length in (columns, rows))
    u, v = (axis.reshape(-1) for axis in jnp.meshgrid(*axes))
    right, down = first.raster.warp(T_first_second, second.raster).map_components(u, v)
    values, inside = sample_components(first.with_gaps(), right, down, method=Bilinear())
    return jnp.where(inside, values, jnp.nan).reshape(second.raster.shape)
