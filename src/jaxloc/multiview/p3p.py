"""P3P: camera poses from three points, the minimal solver of RANSAC for PnP."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxloc._arguments import checked
from jaxloc._jit import filter_jit
from jaxloc.poses import SE3, SO3

_PAIRS = ((0, 1), (0, 2), (1, 2))
_POLISH_STEPS = 6


class MinimalPoses(eqx.Module):
    """Solutions of a minimal solver: poses, stacked, and which entries are valid."""

    poses: SE3
    valid: Bool[Array, " k"]


@filter_jit
@checked
def p3p(rays: Float[Array, "3 3"], points_world: Float[Array, "3 3"]) -> MinimalPoses:
    """Camera poses from three points and their rays: up to four.

    The distances l_i of the points obey ``|l_i r_i - l_j r_j|^2 = |X_i - X_j|^2``, evaluated as
    ``(l_i - l_j)^2 + l_i l_j |r_i - r_j|^2``, which avoids cancellation. Eliminating the scale leaves two
    conics; the best conditioned degenerate conic of their pencil (one real root of a cubic) splits into two lines, each
    of which intersects the others in two candidates. They are refined by Newton steps; the last one has the
    derivatives of the implicit function.

    Args:
        rays: "3 3", bearings of any length in the camera frame, one a row.
        points_world: "3 3", world frame, m, one a row.

    Returns:
        Four candidates that map camera to world; `valid` marks distinct solutions with positive distances. Collinear
        points give none; all values are finite. Where two solutions nearly coincide, half of the digits are lost: in
        float32 three in a thousand random problems err by more than 1e-3.

    References:
        Persson and Nordberg, "Lambda Twist: an accurate fast robust perspective three point solver", ECCV 2018; Ding,
        Yang, Larsson, Olsson, Astrom, "Revisiting the P3P problem", CVPR 2023.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> T_world_camera = jl.poses.SE3.from_euler(jnp.array([0.1, 0.2, -5.0]), yaw=0.1, pitch=0.2, roll=0.3)
        >>> points = jnp.array([[1.0, 0.0, 0.0], [-1.0, 1.0, 0.5], [0.0, -1.0, 1.0]])
        >>> rays = T_world_camera.inverse().apply(points)
        >>> found = jl.multiview.p3p(rays / jnp.linalg.norm(rays, axis=1, keepdims=True), points)
        >>> error = jnp.abs(found.poses.translation - T_world_camera.translation[None]).max(1)
        >>> bool((jnp.where(found.valid, error, jnp.inf) < 1e-3).any())
        True
    """
    sides = jnp.stack([jnp.sum((points_world[i] - points_world[j]) ** 2) for i, j in _PAIRS])
    size = jnp.sum(sides)
    safe_size = jnp.where(size > 0, size, 1.0)
    rays = jax.vmap(_unit)(rays)
    chords = jnp.stack([jnp.sum((rays[i] - rays[j]) ** 2) for i, j in _PAIRS])
    frozen_chords, shape = lax.stop_gradient((chords, sides / safe_size))
    directions = _directions(frozen_chords, shape)
    root = lax.stop_gradient(jnp.sqrt(safe_size))

    def candidate(direction):
        distances = _polish(frozen_chords, _scaled(frozen_chords, direction), shape)
        residual, _ = _equations(frozen_chords, distances, shape)
        tolerance = 1e3 * float(jnp.finfo(shape.dtype).eps)
        valid = jnp.all(distances > 0) & (jnp.max(jnp.abs(residual)) < tolerance)
        distances = jnp.where(valid, distances, 1.0) * root
        live, jacobian = _equations(chords, distances, sides)
        return distances - jnp.where(valid, _solve(lax.stop_gradient(jacobian), live), 0.0), valid

    distances, valid = jax.vmap(candidate)(directions)
    valid &= _is_first(lax.stop_gradient(distances), valid)
    frame_world, squared_sine = _frame(points_world[1] - points_world[0], points_world[2] - points_world[0])

    def pose(distances):
        # From differences of rays, which are exact; differences of points would cancel.
        edges = [(distances[k] - distances[0]) * rays[k] + distances[0] * (rays[k] - rays[0]) for k in (1, 2)]
        rotation = _product(frame_world, _frame(*edges)[0].T)
        middle = jnp.mean(distances[:, None] * rays, axis=0)
        translation = jnp.mean(points_world, axis=0) - jnp.sum(rotation * middle[None], axis=1)
        return SE3(SO3.from_matrix(rotation), translation)

    return MinimalPoses(jax.vmap(pose)(distances), valid & (squared_sine > 1e3 * float(jnp.finfo(shape.dtype).eps)))


def _directions(chords: Float[Array, "3"], shape: Float[Array, "3"]) -> Float[Array, "4 3"]:
    """Common zeros of the two conics in the distances, up to scale."""
    first, second = _pencil(chords, shape)
    root = _largest_root(*_cubic(first, second))
    degenerate, other = first + root * second, second - root * first
    return jax.vmap(_intersect, in_axes=(0, None))(_lines(degenerate), other).reshape(4, 3)


def _pencil(chords: Float[Array, "3"], shape: Float[Array, "3"]) -> tuple[Array, Array]:
    """An orthonormal basis of the pencil of conics, the second far from degenerate."""
    quadrics, eye = [], jnp.eye(3, dtype=chords.dtype)
    for (i, j), chord in zip(_PAIRS, chords, strict=True):
        cosine = 1.0 - 0.5 * chord
        cross = eye[i][:, None] * eye[j][None, :]
        quadrics.append(
            eye[i][:, None] * eye[i][None, :] + eye[j][:, None] * eye[j][None, :] - cosine * (cross + cross.T)
        )
    first = _unit(shape[2] * quadrics[0] - shape[0] * quadrics[2])
    second = shape[2] * quadrics[1] - shape[1] * quadrics[2]
    second = _unit(second - jnp.sum(first * second) * first)
    c0, c1, c2, c3 = _cubic(first, second)
    turns = [(1.0, 0.0), (0.0, 1.0), (0.5**0.5, 0.5**0.5), (0.5**0.5, -(0.5**0.5))]
    cos, sin = (jnp.array(part, chords.dtype) for part in zip(*turns, strict=True))
    best = jnp.argmax(jnp.abs(c0 * cos**3 + c1 * cos**2 * sin + c2 * cos * sin**2 + c3 * sin**3))
    cos, sin = cos[best], sin[best]
    return cos * second - sin * first, cos * first + sin * second


def _adjugate(matrix: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """Adjugate of a symmetric matrix: the cross products of its columns."""
    a, b, c = matrix
    return jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)])


def _cubic(first: Array, second: Array) -> tuple[Array, ...]:
    """Coefficients of ``det(first + t second)``, constant first."""
    adjugates = _adjugate(first), _adjugate(second)
    c0, c3 = jnp.sum(first[0] * adjugates[0][0]), jnp.sum(second[0] * adjugates[1][0])
    return c0, jnp.sum(adjugates[0] * second), jnp.sum(adjugates[1] * first), c3


def _largest_root(c0: Array, c1: Array, c2: Array, c3: Array) -> Array:
    """The real root of a cubic farthest from the mean of its roots: the best separated one."""
    c3 = jnp.where(c3 == 0, 1.0, c3)
    a, b, c = c2 / c3 / 3.0, c1 / c3, c0 / c3
    p, q = b / 3.0 - a * a, a**3 - 0.5 * a * b + 0.5 * c  # x^3 + 3 p x + 2 q = 0 with x = t + a
    discriminant = q * q + p**3
    sign = jnp.where(q > 0, -1.0, 1.0).astype(q.dtype)
    single = jnp.cbrt(jnp.abs(q) + jnp.sqrt(jnp.maximum(discriminant, 0.0)))
    single = single - p / jnp.where(single > 0, single, 1.0)
    radius = jnp.sqrt(jnp.maximum(-p, 0.0))
    ratio = jnp.abs(q) / jnp.where(radius > 0, radius, 1.0) ** 3
    triple = 2.0 * radius * jnp.cos(jnp.arccos(jnp.minimum(ratio, 1.0)) / 3.0)
    root = sign * jnp.where(discriminant > 0, single, triple) - a
    for _ in range(2):
        value = ((root + 3.0 * a) * root + b) * root + c
        slope = (3.0 * root + 6.0 * a) * root + b
        root = root - jnp.where(slope != 0, value / jnp.where(slope != 0, slope, 1.0), 0.0)
    return root


def _lines(conic: Float[Array, "3 3"]) -> Float[Array, "2 3"]:
    """The two real lines of a degenerate conic."""
    product = -_adjugate(conic)
    column = jnp.argmax(jnp.diagonal(product))
    length = jnp.sqrt(jnp.maximum(product[column, column], float(jnp.finfo(conic.dtype).tiny) ** 0.5))
    x, y, z = product[:, column] / length
    zero = jnp.zeros_like(x)
    cross = jnp.stack([jnp.stack([zero, -z, y]), jnp.stack([z, zero, -x]), jnp.stack([-y, x, zero])])
    outer = conic + cross  # of rank one
    largest = jnp.argmax(jnp.abs(outer))
    return jnp.stack([outer[largest // 3, :], outer[:, largest % 3]])


def _intersect(line: Float[Array, "3"], conic: Float[Array, "3 3"]) -> Float[Array, "2 3"]:
    """The two intersections of a line and a conic (the real part of a complex pair)."""
    line = _unit(line)
    axis = jnp.eye(3, dtype=line.dtype)[jnp.argmin(jnp.abs(line))]
    u = _unit(jnp.cross(line, axis))
    v = jnp.cross(line, u)
    conic_u, conic_v = jnp.sum(conic * u[None], axis=1), jnp.sum(conic * v[None], axis=1)
    a, b, c = jnp.sum(u * conic_u), jnp.sum(u * conic_v), jnp.sum(v * conic_v)
    w = -(b + jnp.where(b < 0, -1.0, 1.0).astype(b.dtype) * jnp.sqrt(jnp.maximum(b * b - a * c, 0.0)))
    return jnp.stack([w * u + a * v, c * u + w * v])


def _scaled(chords: Array, direction: Array) -> Array:
    """A direction in the space of distances, made positive and scaled to a triangle of size one."""
    direction = _unit(direction)
    direction = direction * jnp.where(jnp.sum(direction) < 0, -1.0, 1.0).astype(direction.dtype)
    size = jnp.sum(_equations(chords, direction, jnp.zeros_like(chords))[0])
    return direction / jnp.sqrt(jnp.maximum(size, float(jnp.finfo(size.dtype).eps) ** 2))


def _equations(chords: Array, distances: Array, sides: Array) -> tuple[Array, Array]:
    """Residuals of the squared sides, and for each side its derivatives by its two distances."""
    residuals, slopes = [], []
    for (i, j), chord, side in zip(_PAIRS, chords, sides, strict=True):
        first, second = distances[i], distances[j]
        residuals.append((first - second) ** 2 + first * second * chord - side)
        slopes.append(jnp.stack([2.0 * (first - second) + second * chord, 2.0 * (second - first) + first * chord]))
    return jnp.stack(residuals), jnp.stack(slopes)


def _solve(slopes: Float[Array, "3 2"], right: Float[Array, "3"]) -> Float[Array, "3"]:
    """Cramer's rule for ``[[a, b, 0], [c, 0, d], [0, e, f]]``."""
    (a, b), (c, d), (e, f) = slopes
    x = -right[0] * d * e - b * right[1] * f + b * d * right[2]
    y = a * (right[1] * f - d * right[2]) - right[0] * c * f
    z = -a * right[1] * e - b * c * right[2] + right[0] * c * e
    determinant = -a * d * e - b * c * f
    return jnp.stack([x, y, z]) / jnp.where(determinant == 0, 1.0, determinant)


def _polish(chords: Array, distances: Array, shape: Array) -> Array:
    def improve(_, distances):
        residual, slopes = _equations(chords, distances, shape)
        bound = 0.3 * jnp.max(jnp.abs(distances))
        return distances - jnp.clip(_solve(slopes, residual), -bound, bound)

    return lax.fori_loop(0, _POLISH_STEPS, improve, distances)


def _is_first(distances: Float[Array, "4 3"], valid: Bool[Array, "4"]) -> Bool[Array, "4"]:
    """False for candidates that repeat an earlier valid one: two may converge to the same solution."""
    near = 4.0 * float(jnp.finfo(distances.dtype).eps) ** 0.5 * jnp.max(distances)
    same = jnp.max(jnp.abs(distances[:, None] - distances[None]), axis=-1) < near
    index = jnp.arange(4)
    return ~jnp.any(same & valid[None, :] & (index[None, :] < index[:, None]), axis=1)


def _frame(first: Float[Array, "3"], second: Float[Array, "3"]) -> tuple[Float[Array, "3 3"], Array]:
    """Orthonormal axes (columns) of two edges, and the squared sine of their angle."""
    first, second = _unit(first), _unit(second)
    normal = jnp.cross(first, second)
    squared_sine = jnp.sum(normal * normal)
    z = _unit(normal)
    return jnp.stack([first, jnp.cross(z, first), z], axis=1), squared_sine


def _unit(value: Array) -> Array:
    square = jnp.sum(value * value)
    good = square > float(jnp.finfo(value.dtype).tiny) ** 0.75
    return jnp.where(good, value, 0.0) / jnp.sqrt(jnp.where(good, square, 1.0))


def _product(a: Float[Array, "3 3"], b: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """Matrix product by elementwise sums: batches of tiny library products are slow on CPUs."""
    return jnp.sum(a[:, :, None] * b[None, :, :], axis=1)
