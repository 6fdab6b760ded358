"""Eight-point and seven-point algorithms for the fundamental matrix.

The convention is that of `epipolar`: ``x1^T F x2 = 0``. The singular value decomposition is not differentiated:
null vectors and roots are found without derivatives, and one Newton step on their defining equations gives those
of the implicit function.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxloc import _linalg
from jaxloc._arguments import checked
from jaxloc._jit import filter_jit
from jaxloc._linalg import matmul
from jaxloc.multiview.epipolar import homogeneous
from jaxloc.multiview.homography import normalizer
from jaxloc.solvers.estimate import guarded

_LEAST, _MINIMAL = 8, 7
_POLISH_STEPS = 3
# The null vector is accepted when the next singular value exceeds its own by this factor.
_SEPARATION = 2.0


class FundamentalMatrix(eqx.Module):
    """Result of the eight-point algorithm.

    Attributes:
        matrix: "3 3" of rank two and unit Frobenius norm.
        separation: the second smallest singular value of the equations over the smallest, at most one over rounding:
            a measure of conditioning. Near one for points of a plane, for a rotation alone, and for noise.
        ok: whether the points determine the matrix. Gradients are zero where it is False.
    """

    matrix: Float[Array, "3 3"]
    separation: Float[Array, ""]
    ok: Bool[Array, ""]


class FundamentalMatrices(eqx.Module):
    """Solutions of the seven-point algorithm, stacked, and which entries are valid."""

    matrices: Float[Array, "3 3 3"]
    valid: Bool[Array, "3"]


@filter_jit
@checked
def eight_point(
    first: Float[Array, "n 2"],
    second: Float[Array, "n 2"],
    *,
    weights: Float[Array, " n"] | None = None,
    valid: Bool[Array, " n"] | None = None,
) -> FundamentalMatrix:
    """Eight-point algorithm: fundamental matrix by linear least squares in normalized coordinates.

    Minimizes ``sum w_i (x1_i^T F x2_i)^2`` over unit ``F`` after normalization to zero mean and mean distance
    one, then takes the nearest matrix of rank two. An initial value for `two_view`.

    Args:
        first: points of the first image, px (or normalized coordinates: the essential matrix, nearly).
        second: the corresponding points of the second image.
        weights: of each pair, one by default; pairs with weight zero are ignored.
        valid: pairs that are used; non-finite ones never are.

    Returns:
        The matrix. ``ok`` is False with fewer than eight pairs, and where the equations do not determine the solution:
        points of one plane, on a line, or all in one place, and cameras that only rotate. Eight noisy points fit
        exactly, so that noise cannot be distinguished from structure: the test is more reliable with more points.

    Raises:
        ValueError: fewer than eight pairs.

    References:
        Longuet-Higgins 1981; Hartley, "In defense of the eight-point algorithm", T-PAMI 1997; review section 5.2
        [R-49].

    Example:
        >>> import jax, jax.numpy as jnp, jaxloc as jl
        >>> keys = jax.random.split(jax.random.key(0))
        >>> points = jax.random.uniform(keys[0], (20, 3), minval=-2.0, maxval=2.0) + jnp.array([[0.0, 0.0, 6.0]])
        >>> pose = jl.poses.SE3.exp(jnp.array([0.6, 0.0, 0.8, 0.05, -0.1, 0.02]))
        >>> camera = jl.sensors.Pinhole(500.0, 500.0, 320.0, 240.0)
        >>> first, second = camera.project(points), camera.project(pose.inverse().apply(points))
        >>> found = jl.multiview.fundamental_matrix.eight_point(first, second)
        >>> distance = jl.multiview.epipolar.sampson_distance(found.matrix, first, second)
        >>> bool(found.ok), bool(jnp.abs(distance).max() < 0.05)
        (True, True)
    """
    if first.shape[0] < _LEAST:
        raise ValueError(f"The eight-point algorithm needs {_LEAST} pairs; there are {first.shape[0]}.")
    return guarded(jnp.array(True), _eight_point, first, second, weights, valid)


def _eight_point(first: Array, second: Array, weights: Any, valid: Any) -> FundamentalMatrix:
    used, first, second, weight = _usable(first, second, weights, valid)
    (to_first, x1), (to_second, x2) = (_normalized(points.T, used) for points in (first, second))
    rows = (x1[:, None] * x2[None]).reshape(9, -1) * jnp.sqrt(weight)[None, :]
    rows = jnp.concatenate([rows, jnp.zeros((9, 1), rows.dtype)], axis=1)  # at least nine equations
    vector, values = _null_direction(rows.T)
    matrix = vector.reshape(3, 3)
    right, _ = _null_direction(matrix)
    matrix = matrix - matmul(matrix, right)[:, None] * right[None, :]
    matrix = _unit(matmul(to_first.T, matmul(matrix, to_second)))
    floor = 10.0 * float(jnp.finfo(values.dtype).eps) * values[0]
    separation = values[-2] / jnp.maximum(jnp.maximum(values[-1], floor), float(jnp.finfo(values.dtype).tiny))
    ok = (jnp.sum(used) >= _LEAST) & (values[-2] > _SEPARATION * jnp.maximum(values[-1], floor))
    matrix = jnp.where(jnp.all(jnp.isfinite(matrix)), matrix, 0.0)
    return FundamentalMatrix(jnp.where(ok, matrix, lax.stop_gradient(matrix)), separation, ok)


@filter_jit
@checked
def seven_point(first: Float[Array, "7 2"], second: Float[Array, "7 2"]) -> FundamentalMatrices:
    """Seven-point algorithm: one to three fundamental matrices.

    Seven equations determine ``F = c A + s B`` up to one parameter; ``det F = 0`` is a cubic.

    Args:
        first: points of the first image, px.
        second: the corresponding points of the second image.

    Returns:
        Three candidates of unit Frobenius norm; `valid` marks solutions. With derivatives; all values are finite.

    References:
        Hartley and Zisserman, *Multiple View Geometry*, 2004, section 11.1.2.

    Example:
        >>> import jax, jax.numpy as jnp, jaxloc as jl
        >>> points = jax.random.uniform(jax.random.key(1), (7, 3), minval=-2.0, maxval=2.0)
        >>> points = points + jnp.array([[0.0, 0.0, 6.0]])
        >>> pose = jl.poses.SE3.exp(jnp.array([0.6, 0.0, 0.8, 0.05, -0.1, 0.02]))
        >>> camera = jl.sensors.Pinhole(500.0, 500.0, 320.0, 240.0)
        >>> first, second = camera.project(points), camera.project(pose.inverse().apply(points))
        >>> found = jl.multiview.fundamental_matrix.seven_point(first, second)
        >>> distance = jax.vmap(jl.multiview.epipolar.sampson_distance, in_axes=(0, None, None))
        >>> off = jnp.abs(distance(found.matrices, first, second)).max(1)
        >>> bool(found.valid.any()), bool((off < 0.05)[found.valid].all())
        (True, True)
    """
    used, first, second, _ = _usable(first, second, None, None)
    (to_first, x1), (to_second, x2) = (_normalized(points.T, used) for points in (first, second))
    rows = (x1[:, None] * x2[None]).reshape(9, -1).T
    frozen = lax.stop_gradient(rows)
    q, r = _linalg.qr(frozen.T)
    diagonal = jnp.abs(jnp.diagonal(r))
    spans = jnp.all(used) & (jnp.min(diagonal) > 1e2 * float(jnp.finfo(rows.dtype).eps) * jnp.max(diagonal))
    pencil, roots = _singular_members(q[:, 7].reshape(3, 3), q[:, 8].reshape(3, 3))

    def candidate(root: Array) -> tuple[Array, Array]:
        matrix = _unit(pencil[0] + root * pencil[1])
        for _ in range(_POLISH_STEPS):
            matrix = _unit(matrix - _newton(frozen, frozen, matrix))
        miss = jnp.max(jnp.abs(_equations(frozen, matrix)))
        good = spans & (miss < 1e2 * float(jnp.finfo(rows.dtype).eps))
        step = _newton(rows, frozen, matrix)
        matrix = matrix - jnp.where(good, step - lax.stop_gradient(step), 0.0)
        return _unit(matmul(to_first.T, matmul(matrix, to_second))), good

    matrices, good = jax.vmap(candidate)(roots.values)
    good = good & roots.real & _is_first(matrices, good & roots.real)
    finite = jnp.isfinite(matrices)
    matrices = jnp.where(finite, matrices, 0.0)
    return FundamentalMatrices(jnp.where(good[:, None, None], matrices, lax.stop_gradient(matrices)), good)


def _usable(
    first: Array, second: Array, weights: Array | None, valid: Array | None
) -> tuple[Bool[Array, " n"], Array, Array, Float[Array, " n"]]:
    """Mask of the pairs in use, and points and weights with non-finite values replaced."""
    used = jnp.all(jnp.isfinite(first), axis=1) & jnp.all(jnp.isfinite(second), axis=1)
    used = used if valid is None else used & valid
    weight = jnp.ones(first.shape[:1], first.dtype) if weights is None else lax.stop_gradient(weights)
    used = used & jnp.isfinite(weight) & (weight > 0)
    first, second = (jnp.where(used[:, None], points, 0.0) for points in (first, second))
    return used, first, second, jnp.where(used, weight, 0.0)


def _normalized(points: Float[Array, "2 n"], used: Bool[Array, " n"]) -> tuple[Float[Array, "3 3"], Array]:
    """A similarity, and the mapped homogeneous points; zero where masked."""
    similarity, moved = normalizer(points, used)
    return similarity, jnp.where(used[None, :], homogeneous(moved.T), 0.0)


def _null_direction(rows: Float[Array, "m k"]) -> tuple[Float[Array, " k"], Float[Array, " k"]]:
    """Right singular vector of the smallest singular value, and all singular values.

    Derivative: with ``M = rows^T rows`` and its other pairs (s_k^2, v_k), ``dv = -sum v_k v_k^T dM v / (s_k^2 - s^2)``.
    """
    frozen = lax.stop_gradient(rows)
    _, values, right = _linalg.svd(jnp.where(jnp.isfinite(frozen), frozen, 0.0))
    vector, others = right[-1], right[:-1]
    gaps = values[:-1] ** 2 - values[-1] ** 2
    clear = gaps > (10.0 * float(jnp.finfo(values.dtype).eps) * values[0]) ** 2
    inverse = jnp.where(clear, 1.0 / jnp.where(clear, gaps, 1.0), 0.0)
    pull = matmul(rows.T, matmul(rows, vector))
    shift = matmul(others.T, inverse * matmul(others, pull))
    return vector - (shift - lax.stop_gradient(shift)), values


class _Roots(NamedTuple):
    """Roots of a cubic, and which are real."""

    values: Float[Array, "3"]
    real: Bool[Array, "3"]


def _singular_members(first: Float[Array, "3 3"], second: Float[Array, "3 3"]) -> tuple[Float[Array, "2 3 3"], _Roots]:
    """A basis of the pencil, the second matrix far from singular, and the roots of ``det(basis[0] + t basis[1])``."""
    angles = jnp.arange(6, dtype=first.dtype) * (jnp.pi / 6.0)
    turned = jnp.cos(angles)[:, None, None] * first[None] + jnp.sin(angles)[:, None, None] * second[None]
    best = jnp.argmax(jnp.abs(jax.vmap(_determinant)(turned)))
    cos, sin = jnp.cos(angles[best]), jnp.sin(angles[best])
    a, b = cos * second - sin * first, cos * first + sin * second
    lead = _determinant(b)
    lead = jnp.where(lead == 0, 1.0, lead)
    return jnp.stack([a, b]), _cubic(
        jnp.sum(_cofactors(b) * a) / lead, jnp.sum(_cofactors(a) * b) / lead, _determinant(a) / lead
    )


def _cubic(a: Array, b: Array, c: Array) -> _Roots:
    """Roots of ``t^3 + a t^2 + b t + c``; a pair that is complex by rounding alone used as real."""
    shift = a / 3.0
    p, q = b / 3.0 - shift**2, shift**3 - 0.5 * shift * b + 0.5 * c  # y^3 + 3 p y + 2 q = 0
    discriminant = q * q + p**3
    root = jnp.sqrt(jnp.maximum(discriminant, 0.0))
    outer = jnp.cbrt(jnp.abs(q) + root) * jnp.where(q > 0, -1.0, 1.0).astype(q.dtype)
    single = outer - p / jnp.where(outer == 0, 1.0, outer)
    radius = jnp.sqrt(jnp.maximum(-p, 0.0))
    ratio = jnp.clip(-q / jnp.where(radius > 0, radius, 1.0) ** 3, -1.0, 1.0)
    third = jnp.arccos(ratio) / 3.0
    triple = jnp.stack([2.0 * radius * jnp.cos(third + k * 2.0 * jnp.pi / 3.0) for k in range(3)])
    one = discriminant > 0
    pair = jnp.stack([single, -0.5 * single, -0.5 * single])
    nearly = discriminant <= float(jnp.finfo(q.dtype).eps) ** 0.5 * (q * q + jnp.abs(p) ** 3)
    return _Roots(jnp.where(one, pair, triple) - shift, jnp.stack([jnp.array(True), ~one | nearly, ~one | nearly]))


def _cofactors(matrix: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    a, b, c = matrix
    return jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)])


def _determinant(matrix: Float[Array, "3 3"]) -> Float[Array, ""]:
    return jnp.sum(matrix[0] * jnp.cross(matrix[1], matrix[2]))


def _equations(rows: Float[Array, "7 9"], matrix: Float[Array, "3 3"]) -> Float[Array, "9"]:
    """Residuals of the seven epipolar constraints, the determinant and the norm."""
    scale = jnp.stack([_determinant(matrix), jnp.sum(matrix * matrix) - 1.0])
    return jnp.concatenate([matmul(rows, matrix.reshape(9)), scale])


def _newton(rows: Float[Array, "7 9"], frozen: Float[Array, "7 9"], matrix: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """Newton step, with derivatives by the rows alone; zero where the solution is not isolated."""
    last = jnp.stack([_cofactors(matrix).reshape(9), 2.0 * matrix.reshape(9)])
    inverse = _linalg.inverse(lax.stop_gradient(jnp.concatenate([frozen, last])))
    inverse = jnp.where(jnp.all(jnp.isfinite(inverse)), inverse, 0.0)
    return matmul(inverse, _equations(rows, matrix)).reshape(3, 3)


def _unit(matrix: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    squared = jnp.sum(matrix * matrix)
    good = jnp.isfinite(squared) & (squared > 0)
    return jnp.where(good, matrix, 0.0) / jnp.sqrt(jnp.where(good, squared, 1.0))


def _is_first(matrices: Float[Array, "3 3 3"], valid: Bool[Array, "3"]) -> Bool[Array, "3"]:
    """False for solutions that repeat an earlier one, up to sign."""
    flat = lax.stop_gradient(matrices).reshape(3, 9)
    alike = jnp.abs(jnp.sum(flat[:, None] * flat[None], axis=2))
    index = jnp.arange(3)
    near = 1.0 - 10.0 * float(jnp.finfo(flat.dtype).eps)
    return ~jnp.any((alike > near) & valid[None, :] & (index[None, :] < index[:, None]), axis=1)
