"""Minimal solvers for cameras with known vertical direction, from an accelerometer or a flat floor.

Both frames are level: their y axes point down along gravity, so that rotations between them turn about y alone. Rays of
a tilted camera are rotated to level first.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxloc._arguments import checked
from jaxloc._jit import filter_jit
from jaxloc.multiview.epipolar import depth_signs, null_vector
from jaxloc.multiview.p3p import MinimalPoses
from jaxloc.poses import SE3, SO3

_POLISH_STEPS = 4


@filter_jit
@checked
def upright_p2p(rays: Float[Array, "2 3"], points_world: Float[Array, "2 3"]) -> MinimalPoses:
    """P2P with known vertical: poses of a level camera from two points and their rays, up to two.

    The heights give a linear equation in the distances, the horizontal distance of the points a quadratic one.

    Args:
        rays: unit bearings in the level camera frame, one a row.
        points_world: level world frame, m, one a row.

    Returns:
        Two candidates that map camera to world. None is valid for vertically aligned points, for two rays along the
        horizon, or for coincident points; all values are finite.

    References:
        Kukelova, Bujnak, Pajdla, "Closed-form solutions to minimal absolute pose problems with known vertical
        direction", ACCV 2010, section 3.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> points = jnp.array([[1.0, 0.5, 5.0], [-1.0, -0.5, 6.0]])
        >>> rays = points / jnp.linalg.norm(points, axis=1, keepdims=True)
        >>> found = jl.multiview.upright.upright_p2p(rays, points)
        >>> bool((found.valid & (jnp.abs(found.poses.translation).max(1) < 1e-4)).any())
        True
    """
    (a, b), horizontal = rays[:, 1], rays[:, jnp.array([0, 2])]
    rise = points_world[0] - points_world[1]
    across = jnp.stack([rise[0], rise[2]])
    slope = a * a + b * b
    determined = slope > 1e2 * float(jnp.finfo(rays.dtype).eps) ** 2
    slope = jnp.where(determined, slope, 1.0)
    # Distances that fulfill the equation of heights: a line, given by a point and a direction.
    foot, along = rise[1] * jnp.stack([a, -b]) / slope, jnp.stack([b, a]) / jnp.sqrt(slope)

    def difference(distances: Array) -> Array:
        return distances[0] * horizontal[0] - distances[1] * horizontal[1]

    base, change = difference(foot), difference(along)
    squared = jnp.sum(change * change)
    moves = determined & (squared > 1e2 * float(jnp.finfo(rays.dtype).eps) ** 2)
    half, rest = jnp.sum(base * change), jnp.sum(base * base) - jnp.sum(across * across)
    discriminant = half * half - squared * rest
    real = moves & (discriminant >= 0) & (jnp.sum(across * across) > 0)
    root = jnp.where(real, jnp.sqrt(jnp.where(real & (discriminant > 0), discriminant, 1.0)), 0.0)
    root = jnp.where(discriminant > 0, root, 0.0)

    def pose(sign: Array) -> tuple[SE3, Array]:
        distances = foot + along * (sign * root - half) / jnp.where(moves, squared, 1.0)
        valid = real & jnp.all(distances > 0)
        distances = jnp.where(valid, distances, 1.0)
        turn = _turn_between(difference(distances), across, valid)
        determined_points = jnp.sum(turn * (distances[0] * rays[0])[None, :], axis=1)
        return SE3(SO3(turn), jnp.where(valid, points_world[0] - determined_points, 0.0)), valid

    poses, valid = jax.vmap(pose)(jnp.array([1.0, -1.0], rays.dtype))
    return MinimalPoses(poses, valid & (jnp.array([True, False]) | (root > 0)))


def _turn_between(inner: Float[Array, "2"], outer: Float[Array, "2"], valid: Bool[Array, ""]) -> Float[Array, "3 3"]:
    """Rotation about y that maps the direction of the horizontal (x, z) vector ``inner`` to that of ``outer``."""
    cos = inner[0] * outer[0] + inner[1] * outer[1]
    sin = inner[1] * outer[0] - inner[0] * outer[1]
    squared = cos * cos + sin * sin
    good = valid & (squared > 0)
    length = jnp.sqrt(jnp.where(good, squared, 1.0))
    return _about_y(jnp.where(good, cos / length, 1.0), jnp.where(good, sin / length, 0.0))


def _about_y(cos: Float[Array, ""], sin: Float[Array, ""]) -> Float[Array, "3 3"]:
    zero, one = jnp.zeros_like(cos), jnp.ones_like(cos)
    rows = ((cos, zero, sin), (zero, one, zero), (-sin, zero, cos))
    return jnp.stack([jnp.stack(row) for row in rows])


@filter_jit
@checked
def upright_relative(first: Float[Array, "3 3"], second: Float[Array, "3 3"]) -> MinimalPoses:
    """Relative poses of two level cameras from three correspondences: up to four, translations of unit length.

    ``t . (R(a) y_i x x_i) = 0`` for three pairs of rays says that a 3x3 matrix is singular. Its determinant is a
    trigonometric polynomial of degree two in the angle a, known from five values; its zeros are those of a quartic.

    Args:
        first: unit bearings in the first level frame, one a row.
        second: of the same points in the second.

    Returns:
        Four candidates ``T_first_second``; `valid` marks distinct solutions with all points in front of the cameras.
        All values are finite.

    References:
        Fraundorfer, Tanskanen, Pollefeys, "A minimal case solution to the calibrated relative pose problem for the case
        of two known orientation angles", ECCV 2010; Sweeney, Flynn, Turk, 3DV 2014.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> points = jnp.array([[1.0, 0.5, 5.0], [-1.0, -0.5, 6.0], [0.5, -1.0, 4.0]])
        >>> T_first_second = jl.poses.SE3(jl.poses.SO3.exp(jnp.array([0.0, 0.2, 0.0])), jnp.array([0.6, 0.0, 0.8]))
        >>> unit = lambda p: p / jnp.linalg.norm(p, axis=1, keepdims=True)
        >>> second = T_first_second.inverse().apply(points)
        >>> found = jl.multiview.upright.upright_relative(unit(points), unit(second))
        >>> error = jnp.abs(found.poses.translation - T_first_second.translation[None]).max(1)
        >>> bool((found.valid & (error < 1e-3)).any())
        True
    """
    frozen = lax.stop_gradient((first, second))
    waves = _waves(*frozen)
    angles, real = _zeros(waves)
    live = _waves(first, second)
    tolerance = 1e3 * float(jnp.finfo(first.dtype).eps) * jnp.max(jnp.abs(waves))

    def pose(angle: Array, real: Array) -> tuple[SE3, Array]:
        value, slope = _value_and_slope(live, angle)
        steep = real & (jnp.abs(lax.stop_gradient(value)) <= tolerance) & (slope != 0)
        angle = angle - jnp.where(steep, value / jnp.where(slope != 0, slope, 1.0), 0.0)
        turn = _about_y(jnp.cos(angle), jnp.sin(angle))
        rotated = jnp.sum(turn[None] * second[:, None, :], axis=2)
        rows = jnp.cross(rotated, first)
        direction, unique = null_vector(rows)
        distinct = jnp.max(jnp.abs(rows)) > 10.0 * float(jnp.finfo(rows.dtype).eps)
        signs = depth_signs(direction, first, rotated)
        in_front, behind = jnp.all(signs > 0), jnp.all(signs < 0)
        return SE3(SO3(turn), jnp.where(behind, -direction, direction)), steep & unique & distinct & (in_front | behind)

    poses, valid = jax.vmap(pose)(angles, real)
    return MinimalPoses(poses, valid & _is_first(angles, valid))


def _rows(first: Array, second: Array, turn: Array) -> Float[Array, "3 3"]:
    """Normals of the epipolar planes, all orthogonal to the translation."""
    return jnp.cross(jnp.sum(turn[None] * second[:, None, :], axis=2), first)


def _determinant(first: Array, second: Array, angle: Array) -> Float[Array, ""]:
    a, b, c = _rows(first, second, _about_y(jnp.cos(angle), jnp.sin(angle)))
    return jnp.sum(a * jnp.cross(b, c))


def _waves(first: Array, second: Array) -> Float[Array, "5"]:
    """Coefficients of 1, cos, sin, cos 2a, sin 2a of the determinant, by a Fourier transform of five values."""
    angles = jnp.arange(5, dtype=first.dtype) * (2.0 * jnp.pi / 5.0)
    values = jax.vmap(lambda angle: _determinant(first, second, angle))(angles)
    basis = [jnp.full_like(angles, 0.5), *(f(k * angles) for k in (1.0, 2.0) for f in (jnp.cos, jnp.sin))]
    return 0.4 * jnp.sum(jnp.stack(basis) * values[None, :], axis=1)


def _value_and_slope(waves: Float[Array, "5"], angle: Array) -> tuple[Array, Array]:
    cos, sin, cos2, sin2 = jnp.cos(angle), jnp.sin(angle), jnp.cos(2.0 * angle), jnp.sin(2.0 * angle)
    value = waves[0] + waves[1] * cos + waves[2] * sin + waves[3] * cos2 + waves[4] * sin2
    return value, waves[2] * cos - waves[1] * sin + 2.0 * (waves[4] * cos2 - waves[3] * sin2)


def _zeros(waves: Float[Array, "5"]) -> tuple[Float[Array, "4"], Bool[Array, "4"]]:
    """Angles where the trigonometric polynomial is zero, and which are real.

    The tangent of half the angle makes it a quartic. The largest determinant is moved to a half turn, so that
    the leading coefficient is not small.
    """
    samples = jnp.arange(8, dtype=waves.dtype) * (jnp.pi / 4.0)
    values = jax.vmap(lambda angle: _value_and_slope(waves, angle)[0])(samples)
    shift = samples[jnp.argmax(jnp.abs(values))] - jnp.pi
    c1, s1, c2, s2 = jnp.cos(shift), jnp.sin(shift), jnp.cos(2.0 * shift), jnp.sin(2.0 * shift)
    a0, a1, b1 = waves[0], waves[1] * c1 + waves[2] * s1, waves[2] * c1 - waves[1] * s1
    a2, b2 = waves[3] * c2 + waves[4] * s2, waves[4] * c2 - waves[3] * s2
    lead = a0 - a1 + a2
    lead = jnp.where(lead == 0, 1.0, lead)
    coefficients = [2.0 * b1 - 4.0 * b2, 2.0 * a0 - 6.0 * a2, 2.0 * b1 + 4.0 * b2, a0 + a1 + a2]
    roots, real = _quartic(*[coefficient / lead for coefficient in coefficients])
    angles = 2.0 * jnp.arctan(roots) + shift

    def polish(_: Any, angles: Array) -> Array:
        value, slope = jax.vmap(lambda angle: _value_and_slope(waves, angle))(angles)
        step = value / jnp.where(slope == 0, 1.0, slope)
        return angles - jnp.where(slope == 0, 0.0, jnp.clip(step, -0.1, 0.1))

    return lax.fori_loop(0, _POLISH_STEPS, polish, angles), real


def _quartic(a: Array, b: Array, c: Array, d: Array) -> tuple[Float[Array, "4"], Bool[Array, "4"]]:
    """Roots of ``x^4 + a x^3 + b x^2 + c x + d`` by Descartes' two quadratics, and which are real.

    A complex pair that is nearly real counts as a double root; all roots are tested later.
    """
    shift = 0.25 * a
    p = b - 6.0 * shift**2
    q = c - 2.0 * shift * b + 8.0 * shift**3
    r = d - shift * c + shift**2 * b - 3.0 * shift**4
    square = jnp.maximum(_largest_root(2.0 * p, p * p - 4.0 * r, -q * q), 0.0)
    root = jnp.sqrt(square)
    ratio = jnp.where(root > 0, q / jnp.where(root > 0, root, 1.0), 0.0)
    # Without linear term the constants are the roots of y^2 - p y + r.
    gap = jnp.sqrt(jnp.maximum(p * p - 4.0 * r, 0.0))
    low, high = (jnp.where(root > 0, 0.5 * (p + square - s * ratio), 0.5 * (p - s * gap)) for s in (1.0, -1.0))
    pairs = [_quadratic(root, low), _quadratic(-root, high)]
    return jnp.concatenate([x for x, _ in pairs]) - shift, jnp.concatenate([real for _, real in pairs])


def _quadratic(b: Array, c: Array) -> tuple[Float[Array, "2"], Bool[Array, "2"]]:
    discriminant = 0.25 * b * b - c
    scale = 0.25 * b * b + jnp.abs(c)
    real = discriminant >= -(float(jnp.finfo(b.dtype).eps) ** 0.5) * scale
    root = jnp.sqrt(jnp.maximum(discriminant, 0.0))
    return jnp.stack([-0.5 * b + root, -0.5 * b - root]), jnp.stack([real, real])


def _largest_root(a: Array, b: Array, c: Array) -> Array:
    """The largest real root of ``x^3 + a x^2 + b x + c``."""
    shift = a / 3.0
    p, q = b / 3.0 - shift * shift, shift**3 - 0.5 * shift * b + 0.5 * c  # y^3 + 3 p y + 2 q = 0
    discriminant = q * q + p**3
    root = jnp.sqrt(jnp.maximum(discriminant, 0.0))
    outer = jnp.cbrt(jnp.abs(q) + root) * jnp.where(q > 0, -1.0, 1.0).astype(q.dtype)
    single = outer - p / jnp.where(outer == 0, 1.0, outer)
    radius = jnp.sqrt(jnp.maximum(-p, 0.0))
    ratio = jnp.clip(-q / jnp.where(radius > 0, radius, 1.0) ** 3, -1.0, 1.0)
    return jnp.where(discriminant > 0, single, 2.0 * radius * jnp.cos(jnp.arccos(ratio) / 3.0)) - shift


def _is_first(angles: Float[Array, "4"], valid: Bool[Array, "4"]) -> Bool[Array, "4"]:
    """False for angles that repeat an earlier valid one."""
    near = float(jnp.finfo(angles.dtype).eps) ** 0.5
    difference = jnp.abs(jnp.sin(0.5 * (angles[:, None] - angles[None, :])))
    index = jnp.arange(4)
    return ~jnp.any((difference < near) & valid[None, :] & (index[None, :] < index[:, None]), axis=1)
