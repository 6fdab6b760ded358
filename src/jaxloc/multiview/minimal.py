"""Poses from the fewest correspondences: what hypothesize-and-test needs by the thousand."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxloc.poses import SE3, SO3

_PAIRS = ((0, 1), (0, 2), (1, 2))
_POLISH_STEPS = 6


class MinimalPoses(eqx.Module):
    """The candidates of a minimal solver: ``T_world_camera`` stacked, and which of them are solutions."""

    poses: SE3
    valid: Bool[Array, " k"]


@eqx.filter_jit
def p3p(rays: Float[Array, "3 3"], points_world: Float[Array, "3 3"]) -> MinimalPoses:
    """Camera poses that see three points along three rays: up to four.

    The distances l_i of the points obey ``|l_i r_i - l_j r_j|^2 = |X_i - X_j|^2``. Eliminating the scale leaves two
    conics; the best conditioned degenerate conic of their pencil (one real root of a cubic) splits into two lines, each
    of which meets the others in two candidates. Newton steps on the distances polish them; the last one carries the
    derivatives of the implicit function.

    Args:
        rays: "3 3", unit bearings in the camera frame, one a row.
        points_world: "3 3", world frame, m, one a row.

    Returns:
        Four candidates that map camera to world; `valid` marks solutions with positive distances, each once. Collinear
        points give none; everything stays finite.

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
    frozen_rays, shape = lax.stop_gradient((rays, sides / safe_size))
    directions = _directions(frozen_rays, shape)
    root = lax.stop_gradient(jnp.sqrt(safe_size))

    def candidate(direction):
        distances = _polished(frozen_rays, _scaled(frozen_rays, direction), shape)
        residual, _ = _equations(frozen_rays, distances, shape)
        tolerance = 1e3 * float(jnp.finfo(shape.dtype).eps)
        valid = jnp.all(distances > 0) & (jnp.max(jnp.abs(residual)) < tolerance)
        distances = jnp.where(valid, distances, 1.0) * root
        live, jacobian = _equations(rays, distances, sides)
        return distances - jnp.where(valid, _solve(lax.stop_gradient(jacobian), live), 0.0), valid

    distances, valid = jax.vmap(candidate)(directions)
    valid &= _first_of_its_kind(lax.stop_gradient(distances), valid)
    frame_world, spread = _frame(points_world)

    def pose(distances):
        points = distances[:, None] * rays
        rotation = _product(frame_world, _frame(points)[0].T)
        translation = jnp.mean(points_world, axis=0) - jnp.sum(rotation * jnp.mean(points, axis=0)[None], axis=1)
        return SE3(SO3.from_matrix(rotation), translation)

    return MinimalPoses(jax.vmap(pose)(distances), valid & (spread > 1e3 * float(jnp.finfo(shape.dtype).eps)))


def _directions(rays: Float[Array, "3 3"], shape: Float[Array, "3"]) -> Float[Array, "4 3"]:
    """Common zeros of the two conics in the distances, up to scale."""
    first, second = _pencil(rays, shape)
    root = _largest_root(*_cubic(first, second))
    degenerate, other = first + root * second, second - root * first
    return jax.vmap(_meet, in_axes=(0, None))(_lines(degenerate), other).reshape(4, 3)


def _pencil(rays: Float[Array, "3 3"], shape: Float[Array, "3"]) -> tuple[Array, Array]:
    """An orthonormal basis of the conics whose zeros are sought, the second far from degenerate."""
    quadrics = []
    for i, j in _PAIRS:
        cosine = jnp.sum(rays[i] * rays[j])
        eye = jnp.eye(3, dtype=rays.dtype)
        cross = eye[i][:, None] * eye[j][None, :]
        quadrics.append(
            eye[i][:, None] * eye[i][None, :] + eye[j][:, None] * eye[j][None, :] - cosine * (cross + cross.T)
        )
    first = _unit(shape[2] * quadrics[0] - shape[0] * quadrics[2])
    second = shape[2] * quadrics[1] - shape[1] * quadrics[2]
    second = _unit(second - jnp.sum(first * second) * first)
    c0, c1, c2, c3 = _cubic(first, second)
    turns = [(1.0, 0.0), (0.0, 1.0), (0.5**0.5, 0.5**0.5), (0.5**0.5, -(0.5**0.5))]
    cos, sin = (jnp.array(part, rays.dtype) for part in zip(*turns, strict=True))
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
    """The real root of a cubic that lies farthest from the middle of its roots: the best separated one."""
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
    """The two real lines whose product a degenerate conic is."""
    product = -_adjugate(conic)
    column = jnp.argmax(jnp.diagonal(product))
    length = jnp.sqrt(jnp.maximum(product[column, column], float(jnp.finfo(conic.dtype).tiny) ** 0.5))
    x, y, z = product[:, column] / length
    zero = jnp.zeros_like(x)
    cross = jnp.stack([jnp.stack([zero, -z, y]), jnp.stack([z, zero, -x]), jnp.stack([-y, x, zero])])
    outer = conic + cross  # of rank one
    largest = jnp.argmax(jnp.abs(outer))
    return jnp.stack([outer[largest // 3, :], outer[:, largest % 3]])


def _meet(line: Float[Array, "3"], conic: Float[Array, "3 3"]) -> Float[Array, "2 3"]:
    """The two points where a line meets a conic (of a complex pair, the real middle)."""
    line = _unit(line)
    axis = jnp.eye(3, dtype=line.dtype)[jnp.argmin(jnp.abs(line))]
    u = _unit(jnp.cross(line, axis))
    v = jnp.cross(line, u)
    conic_u, conic_v = jnp.sum(conic * u[None], axis=1), jnp.sum(conic * v[None], axis=1)
    a, b, c = jnp.sum(u * conic_u), jnp.sum(u * conic_v), jnp.sum(v * conic_v)
    w = -(b + jnp.where(b < 0, -1.0, 1.0).astype(b.dtype) * jnp.sqrt(jnp.maximum(b * b - a * c, 0.0)))
    return jnp.stack([w * u + a * v, c * u + w * v])


def _scaled(rays: Array, direction: Array) -> Array:
    """A direction in the space of distances, made positive and scaled to a triangle of size one."""
    direction = _unit(direction)
    direction = direction * jnp.where(jnp.sum(direction) < 0, -1.0, 1.0).astype(direction.dtype)
    size = sum(jnp.sum((direction[i] * rays[i] - direction[j] * rays[j]) ** 2) for i, j in _PAIRS)
    return direction / jnp.sqrt(jnp.maximum(size, float(jnp.finfo(size.dtype).eps) ** 2))


def _equations(rays: Array, distances: Array, sides: Array) -> tuple[Array, Array]:
    """Residuals of the squared sides, and for each side its derivatives by its two distances."""
    residuals, slopes = [], []
    for (i, j), side in zip(_PAIRS, sides, strict=True):
        edge = distances[i] * rays[i] - distances[j] * rays[j]
        residuals.append(jnp.sum(edge * edge) - side)
        slopes.append(jnp.stack([2.0 * jnp.sum(edge * rays[i]), -2.0 * jnp.sum(edge * rays[j])]))
    return jnp.stack(residuals), jnp.stack(slopes)


def _solve(slopes: Float[Array, "3 2"], right: Float[Array, "3"]) -> Float[Array, "3"]:
    """Cramer's rule for ``[[a, b, 0], [c, 0, d], [0, e, f]]``."""
    (a, b), (c, d), (e, f) = slopes
    x = -right[0] * d * e - b * right[1] * f + b * d * right[2]
    y = a * (right[1] * f - d * right[2]) - right[0] * c * f
    z = -a * right[1] * e - b * c * right[2] + right[0] * c * e
    determinant = -a * d * e - b * c * f
    return jnp.stack([x, y, z]) / jnp.where(determinant == 0, 1.0, determinant)


def _polished(rays: Array, distances: Array, shape: Array) -> Array:
    def improve(_, distances):
        residual, slopes = _equations(rays, distances, shape)
        bound = 0.3 * jnp.max(jnp.abs(distances))
        return distances - jnp.clip(_solve(slopes, residual), -bound, bound)

    return lax.fori_loop(0, _POLISH_STEPS, improve, distances)


def _first_of_its_kind(distances: Float[Array, "4 3"], valid: Bool[Array, "4"]) -> Bool[Array, "4"]:
    """False for candidates that an earlier valid one repeats: two may polish to one solution."""
    near = 4.0 * float(jnp.finfo(distances.dtype).eps) ** 0.5 * jnp.max(distances)
    same = jnp.max(jnp.abs(distances[:, None] - distances[None]), axis=-1) < near
    index = jnp.arange(4)
    return ~jnp.any(same & valid[None, :] & (index[None, :] < index[:, None]), axis=1)


def _frame(points: Float[Array, "3 3"]) -> tuple[Float[Array, "3 3"], Array]:
    """Orthonormal axes (columns) of a triangle, and how far it is from a line (squared sine of a corner)."""
    first, second = points[1] - points[0], points[2] - points[0]
    first, second = _unit(first), _unit(second)
    normal = jnp.cross(first, second)
    spread = jnp.sum(normal * normal)
    z = _unit(normal)
    return jnp.stack([first, jnp.cross(z, first), z], axis=1), spread


def _unit(value: Array) -> Array:
    square = jnp.sum(value * value)
    good = square > float(jnp.finfo(value.dtype).tiny) ** 0.75
    return jnp.where(good, value, 0.0) / jnp.sqrt(jnp.where(good, square, 1.0))


def _product(a: Float[Array, "3 3"], b: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """Elementwise sums: batches of tiny library products are slow on CPUs."""
    return jnp.sum(a[:, :, None] * b[None, :, :], axis=1)
