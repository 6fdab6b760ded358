"""Five-point algorithm: relative poses of two calibrated views from five correspondences.

The essential matrix lies in a space of four dimensions, ``E = x X + y Y + z Z + W``. Ten cubic equations in x, y, z
constrain them; eliminating x and y leaves a polynomial of degree ten in z. All its roots are found at once, without the
eigenvalues of a companion matrix, which accelerators lack; Newton steps on the manifold refine the real solutions.
"""

import itertools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxloc import _linalg
from jaxloc._arguments import checked
from jaxloc._jit import filter_jit
from jaxloc._linalg import matmul
from jaxloc.multiview.epipolar import RelativePose, depth_signs, null_vector, unit_rays
from jaxloc.poses import SO3, Direction, retract
from jaxloc.poses.lie_group import skew
from jaxloc.solvers.cholesky import factor

_ROOT_STEPS = 25
_POLISH_STEPS = 3

# Monomials of degree three in (x, y, z, 1), as counts of factors, in Nister's order: ten to eliminate, ten that stay.
_CUBIC = "xxx yyy xxy xyy xxz xx1 yyz yy1 xyz xy1 xzz xz1 x11 yzz yz1 y11 zzz zz1 z11 111".split()
_LETTERS = "xyz1"
_QUADRATIC = ["".join(pair) for pair in itertools.combinations_with_replacement(_LETTERS, 2)]


def _product_table(left: list[str], result: list[str]) -> np.ndarray:
    """Table of products of monomials: one where a monomial times a letter is the result."""
    rank = {letter: place for place, letter in enumerate(_LETTERS)}
    normal = lambda letters: "".join(sorted(letters, key=rank.__getitem__))  # noqa: E731
    names = [normal(name) for name in result]
    table = np.zeros((len(result), len(left), 4))
    for i, j in itertools.product(range(len(left)), range(4)):
        table[names.index(normal(left[i] + _LETTERS[j])), i, j] = 1.0
    return table


_SQUARES = _product_table(list(_LETTERS), _QUADRATIC)
_CUBES = _product_table(_QUADRATIC, _CUBIC)


class RelativePoses(NamedTuple):
    """Solutions of a minimal solver.

    Attributes:
        poses: a stack.
        valid: entries that are solutions.
    """

    poses: RelativePose
    valid: Bool[Array, " k"]


@filter_jit
@checked
def five_point(first: Float[Array, "5 3"], second: Float[Array, "5 3"]) -> RelativePoses:
    """Relative poses of two calibrated views of five points: up to ten essential matrices.

    Args:
        first: rays of the first view (any length), one a row.
        second: rays to the same points, second view.

    Returns:
        Ten candidates, each the one of four poses of its essential matrix with most of the five points in front of
        both cameras; `valid` marks solutions. Without derivatives; all values are finite.

    References:
        Nister, "An efficient solution to the five-point relative pose problem", T-PAMI 2004; Stewenius, Engels, Nister,
        ISPRS 2006; Aberth, Math. Comp. 1973 (the roots).

    Example:
        >>> import jax, jax.numpy as jnp, jaxloc as jl
        >>> T_first_second = jl.poses.SE3.exp(jnp.array([0.6, 0.0, 0.8, 0.1, -0.2, 0.05]))
        >>> points = jax.random.uniform(jax.random.key(0), (5, 3), minval=-1.0) + jnp.array([[0.0, 0.0, 5.0]])
        >>> found = jl.multiview.five_point.five_point(points, T_first_second.inverse().apply(points))
        >>> error = jnp.abs(found.poses.rotation.rotation_matrix - T_first_second.rotation.matrix()[None]).max((1, 2))
        >>> bool((found.valid & (error < 1e-3)).any())
        True
    """
    first, second = (unit_rays(rays) for rays in lax.stop_gradient((first, second)))
    essentials, real = essential_candidates(first[None], second[None])

    def candidate(essential: Array, real: Array) -> tuple[RelativePose, Array]:
        pose = polish(facing(decompose(essential), first, second), first, second)
        return pose, real & _explains(pose, first, second)

    poses, valid = jax.vmap(candidate)(essentials[:, 0], real[:, 0])
    return RelativePoses(poses, valid & _is_first(poses, valid))


@checked
def essential_candidates(
    first: Float[Array, "h 5 3"], second: Float[Array, "h 5 3"]
) -> tuple[Float[Array, "10 h 3 3"], Bool[Array, "10 h"]]:
    """Essential matrices of many samples, up to rounding errors, and which are solutions.

    Samples lie along the last axis of the inner loops.

    Args:
        first: unit rays of the first view, five a sample.
        second: rays of the second view.

    Returns:
        Ten matrices a sample, finite; in float32 of a few digits, which `polish` corrects.
    """
    basis, spans = jax.vmap(_null_space)(first, second)
    rest, regular = jax.vmap(_eliminated)(basis)
    lines = _lines(jnp.moveaxis(rest, 0, -1))
    roots, real = _real_roots(_determinant(lines))
    x, y, w = _null_vectors(lines, roots)
    good = jnp.abs(w) > 1e-6
    scale = jnp.where(good, w, 1.0)
    weights = (x / scale, y / scale, roots, jnp.ones_like(roots))
    essentials = sum(jnp.where(good, c, 0.0)[:, :, None, None] * basis[None, :, k] for k, c in enumerate(weights))
    return essentials, real & good & (spans & regular)[None, :]


def _null_space(first: Float[Array, "5 3"], second: Float[Array, "5 3"]) -> tuple[Float[Array, "4 3 3"], Array]:
    """An orthonormal basis of the matrices with ``x1^T E x2 = 0`` for all five."""
    rows = (first[:, :, None] * second[:, None, :]).reshape(5, 9)
    q, r = _linalg.qr(rows.T)
    diagonal = jnp.abs(jnp.diagonal(r))
    spans = jnp.min(diagonal) > 1e2 * float(jnp.finfo(rows.dtype).eps) * jnp.max(diagonal)
    return q[:, 5:].T.reshape(4, 3, 3), spans


def _eliminated(basis: Float[Array, "4 3 3"]) -> tuple[Float[Array, "10 10"], Bool[Array, ""]]:
    """The ten cubic equations, solved for the first ten monomials."""
    squares, cubes = (jnp.asarray(table, basis.dtype) for table in (_SQUARES, _CUBES))
    products = jnp.einsum("aik,bjk,cab->ijc", basis, basis, squares, precision="highest")
    trace = products[0, 0] + products[1, 1] + products[2, 2]
    centered = products - 0.5 * jnp.eye(3, dtype=basis.dtype)[:, :, None] * trace[None, None, :]
    nine = jnp.einsum("ikc,akj,dca->ijd", centered, basis, cubes, precision="highest").reshape(9, 20)
    minors = jnp.einsum("ai,bj,cab->ijc", basis[:, 1], basis[:, 2], squares, precision="highest")
    minors = minors - jnp.swapaxes(minors, 0, 1)
    cofactors = jnp.stack([minors[1, 2], minors[2, 0], minors[0, 1]])
    last = jnp.einsum("ic,ai,dca->d", cofactors, basis[:, 0], cubes, precision="highest")
    system = jnp.concatenate([nine, last[None]])
    solved = _linalg.solve(system[:, :10], system[:, 10:])
    regular = jnp.all(jnp.isfinite(solved))
    return jnp.where(regular, solved, 0.0), regular


_Polynomial = list[Array]  # coefficients, lowest power first


def _lines(rest: Float[Array, "10 10 h"]) -> list[list[_Polynomial]]:
    """Three equations in (x, y, 1) whose coefficients are polynomials in z, of degrees 3, 3 and 4."""

    def minus_z_times(a: _Polynomial, b: _Polynomial) -> _Polynomial:
        zero = [jnp.zeros_like(a[0])]
        return [p - q for p, q in zip(a + zero, zero + b, strict=True)]

    def polynomials(row: Array) -> list[_Polynomial]:
        return [[row[2], row[1], row[0]], [row[5], row[4], row[3]], [row[9], row[8], row[7], row[6]]]

    return [
        [minus_z_times(a, b) for a, b in zip(polynomials(rest[i]), polynomials(rest[i + 1]), strict=True)]
        for i in (4, 6, 8)
    ]


def _times(a: _Polynomial, b: _Polynomial) -> _Polynomial:
    return [
        sum((a[i] * b[k - i] for i in range(len(a)) if 0 <= k - i < len(b)), start=jnp.zeros_like(a[0]))
        for k in range(len(a) + len(b) - 1)
    ]


def _minor(a: _Polynomial, b: _Polynomial, c: _Polynomial, d: _Polynomial) -> _Polynomial:
    """``a d - b c``."""
    return [p - q for p, q in zip(_times(a, d), _times(b, c), strict=True)]


def _determinant(lines: list[list[_Polynomial]]) -> Float[Array, "11 h"]:
    (a, b, c), (d, e, f), (g, h, i) = lines
    parts = _times(a, _minor(e, f, h, i)), _times(b, _minor(d, f, g, i)), _times(c, _minor(d, e, g, h))
    return jnp.stack([p - q + r for p, q, r in zip(*parts, strict=True)])


def _null_vectors(lines: list[list[_Polynomial]], roots: Float[Array, "10 h"]) -> tuple[Array, Array, Array]:
    """Null vector (x, y, w) of the three equations at each root: the largest cross product of two, normalized."""

    def at(polynomial: _Polynomial) -> Array:
        value = jnp.broadcast_to(polynomial[-1], roots.shape)
        for coefficient in reversed(polynomial[:-1]):
            value = value * roots + coefficient[None]
        return value

    rows = [[at(polynomial) for polynomial in row] for row in lines]
    crosses = []
    for (a, b, c), (d, e, f) in itertools.combinations(rows, 2):
        x, y, w = b * f - c * e, c * d - a * f, a * e - b * d
        crosses.append((x * x + y * y + w * w, x, y, w))
    best = crosses[0]
    for other in crosses[1:]:
        best = tuple(jnp.where(other[0] > best[0], p, q) for p, q in zip(other, best, strict=True))
    some = best[0] > 0
    length = jnp.sqrt(jnp.where(some, best[0], 1.0))
    x, y, w = (jnp.where(some & jnp.isfinite(length), part, 0.0) / length for part in best[1:])
    return x, y, w


def _real_roots(polynomials: Float[Array, "11 h"]) -> tuple[Float[Array, "10 h"], Bool[Array, "10 h"]]:
    """Roots of polynomials, lowest power first, all at once by Aberth's method, and which are real.

    Complex numbers are pairs of real arrays, since complex division is slow.
    """
    dtype, tiny = polynomials.dtype, float(jnp.finfo(polynomials.dtype).eps)
    largest = jnp.max(jnp.abs(polynomials), axis=0)
    known = jnp.isfinite(largest) & (largest > 0)
    c = jnp.where(known[None], polynomials, 1.0) / jnp.where(known, largest, 1.0)[None]
    floor = tiny**2
    c = c.at[-1].set(jnp.where(jnp.abs(c[-1]) > floor, c[-1], floor))
    # Initial values near a circle with the geometric mean of the roots as radius; none is real.
    radius = jnp.clip((jnp.maximum(jnp.abs(c[0]), floor) / jnp.abs(c[-1])) ** 0.1, 1e-3, 1e3)
    angle, scale = 2.0 * np.pi * np.arange(10) / 10 + 0.3, 0.6 + 0.1 * np.arange(10)
    initial = [jnp.asarray(scale * f(angle), dtype)[:, None] * radius[None] for f in (np.cos, np.sin)]

    def step(_: Any, roots: tuple[Array, Array]) -> tuple[Array, Array]:
        re, im = roots
        value = jnp.broadcast_to(c[-1], re.shape), jnp.zeros_like(re)
        slope = jnp.zeros_like(re), jnp.zeros_like(re)
        for k in range(9, -1, -1):
            slope = slope[0] * re - slope[1] * im + value[0], slope[0] * im + slope[1] * re + value[1]
            value = value[0] * re - value[1] * im + c[k][None], value[0] * im + value[1] * re
        newton = _quotient(value, slope)
        difference = re[:, None] - re[None], im[:, None] - im[None]
        squared = difference[0] ** 2 + difference[1] ** 2
        inverse = jnp.where(squared > 0, 1.0 / jnp.where(squared > 0, squared, 1.0), 0.0)
        repulsion = jnp.sum(difference[0] * inverse, axis=1), -jnp.sum(difference[1] * inverse, axis=1)
        keep = (
            1.0 - (newton[0] * repulsion[0] - newton[1] * repulsion[1]),
            -(newton[0] * repulsion[1] + newton[1] * repulsion[0]),
        )
        shift = _quotient(newton, keep)
        good = jnp.isfinite(shift[0]) & jnp.isfinite(shift[1])
        return jnp.where(good, re - shift[0], re), jnp.where(good, im - shift[1], im)

    re, im = lax.fori_loop(0, _ROOT_STEPS, step, (initial[0], initial[1]))
    real = jnp.abs(im) < (tiny**0.3) * (1.0 + jnp.abs(re))
    return jnp.clip(re, -1e4, 1e4), real & known[None]


def _quotient(top: tuple[Array, Array], bottom: tuple[Array, Array]) -> tuple[Array, Array]:
    squared = bottom[0] ** 2 + bottom[1] ** 2
    inverse = 1.0 / jnp.where(squared > 0, squared, 1.0)
    return (top[0] * bottom[0] + top[1] * bottom[1]) * inverse, (top[1] * bottom[0] - top[0] * bottom[1]) * inverse


@checked
def decompose(essential: Float[Array, "3 3"]) -> RelativePose:
    """One of the four poses of an essential matrix; `facing` chooses among them.

    References:
        Horn, "Recovering baseline and orientation from essential matrix", 1990.
    """
    squared = jnp.sum(essential * essential)
    unit = essential * jnp.sqrt(2.0 / jnp.where(squared > 0, squared, 1.0))
    direction, _ = null_vector(unit.T)
    return RelativePose(Direction(direction), _rotation(unit, direction))


def _rotation(essential: Array, direction: Array) -> SO3:
    """``R = cof(E) - [t] E`` for ``E = [t] R``, made orthonormal."""
    a, b, c = essential
    cofactors = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)])
    matrix = cofactors - matmul(skew(direction), essential)
    x, y = _axis(matrix[0], 0), matrix[1]
    y = _axis(y - jnp.sum(x * y) * x, 1)
    z = jnp.cross(x, y)
    return SO3(jnp.stack([x, _axis(jnp.cross(z, x), 1), z]))


def _axis(vector: Float[Array, "3"], fallback: int) -> Float[Array, "3"]:
    squared = jnp.sum(vector * vector)
    some = squared > 1e-20
    safe = jnp.where(some, vector, jnp.eye(3, dtype=vector.dtype)[fallback])
    return safe / jnp.sqrt(jnp.where(some, squared, 1.0))


@checked
def facing(
    pose: RelativePose,
    first: Float[Array, "n 3"],
    second: Float[Array, "n 3"],
    weight: Float[Array, " n"] | None = None,
) -> RelativePose:
    """Cheirality test: of the four poses of an essential matrix, the one with most points in front of both cameras.

    Args:
        pose: any of the four.
        first: rays of the first view.
        second: rays of the second.
        weight: of each pair; one by default.

    Returns:
        The pose.
    """
    t, rotation = pose.direction.vector, pose.rotation.matrix()
    weight = jnp.ones(first.shape[:1], first.dtype) if weight is None else weight
    # Rotation by 180 degrees about the baseline.
    half_turn = 2.0 * t[:, None] * t[None, :] - jnp.eye(3, dtype=t.dtype)
    turns = jnp.stack([rotation, matmul(half_turn, rotation)])

    def count(turn: Array) -> Float[Array, "2"]:
        turned = matmul(second, turn.T)
        signs = depth_signs(t, first, turned)
        both = jnp.all(signs > 0, axis=0), jnp.all(signs < 0, axis=0)
        return jnp.stack([jnp.sum(jnp.where(good, weight, 0.0)) for good in both])

    best = jnp.argmax(jax.vmap(count)(turns).reshape(-1))
    sign = jnp.where(best % 2 == 0, 1.0, -1.0).astype(t.dtype)
    return RelativePose(Direction(sign * t), SO3(turns[best // 2]))


def _coplanarities(pose: RelativePose, first: Array, second: Array) -> Float[Array, " n"]:
    return jnp.sum(first * matmul(second, pose.essential().T), axis=1)


@checked
def polish(pose: RelativePose, first: Float[Array, "5 3"], second: Float[Array, "5 3"]) -> RelativePose:
    """Newton steps on the manifold: five equations, five unknowns."""
    zero = jnp.zeros(5, first.dtype)

    def improve(_: Any, pose: RelativePose) -> RelativePose:
        residual = lambda delta: _coplanarities(retract(pose, delta), first, second)  # noqa: E731
        jacobian = jax.jacfwd(residual)(zero)
        # Normal equations, with small pivots guarded.
        step = factor(matmul(jacobian.T, jacobian)).solve(matmul(jacobian.T, residual(zero)))
        return retract(pose, -jnp.clip(jnp.where(jnp.isfinite(step), step, 0.0), -0.1, 0.1))

    return lax.fori_loop(0, _POLISH_STEPS, improve, pose)


def _explains(pose: RelativePose, first: Array, second: Array) -> Bool[Array, ""]:
    tolerance = 1e2 * float(jnp.finfo(first.dtype).eps)
    return jnp.max(jnp.abs(_coplanarities(pose, first, second))) < tolerance


def _is_first(poses: RelativePose, valid: Bool[Array, "10"]) -> Bool[Array, "10"]:
    """False for solutions that repeat an earlier one."""
    flat = jax.vmap(lambda pose: pose.essential().reshape(-1))(poses)
    distance = jnp.max(jnp.abs(flat[:, None] - flat[None]), axis=2)
    index = jnp.arange(10)
    near = 10.0 * float(jnp.finfo(flat.dtype).eps) ** 0.5
    return ~jnp.any((distance < near) & valid[None, :] & (index[None, :] < index[:, None]), axis=1)
