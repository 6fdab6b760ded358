"""Two-point algorithm for planar motion: relative pose of a level camera on a flat floor."""

from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxloc._arguments import checked
from jaxloc._jit import filter_jit
from jaxloc.multiview.epipolar import depth_signs, unit_rays
from jaxloc.multiview.p3p import MinimalPoses
from jaxloc.poses import SE3, SO3

_POLISH_STEPS = 4


@filter_jit
@checked
def planar_relative(first: Float[Array, "2 3"], second: Float[Array, "2 3"]) -> MinimalPoses:
    """Relative poses of a level camera that moves on a flat floor, from two correspondences: up to two.

    The camera rotates about y by a and translates by ``t = (sin p, 0, cos p)``. Coplanarity is, with ``q = p - a``,
    ``y2 (z1 sin p - x1 cos p) + y1 (x2 cos q - z2 sin q) = 0``: two points give two linear equations between two unit
    vectors, so a quadratic. The length of the translation is not observable.

    Args:
        first: rays in the first level frame (x right, y down, z forward), one a row, any length.
        second: rays to the same points in the second frame.

    Returns:
        Candidates ``T_first_second`` with translations of length one; `valid` marks distinct solutions with both
        points in front of the cameras. None is valid with a point on the horizon (y = 0), with one feature given twice,
        and without motion. All values are finite.

    References:
        Ortin and Montiel, "Indoor robot motion based on monocular images", Robotica 2001; KELLY 9.2.4.3.3 [K-91].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> points = jnp.array([[1.0, 0.5, 5.0], [-1.0, -0.5, 6.0]])
        >>> T_first_second = jl.poses.SE3(jl.poses.SO3.exp(jnp.array([0.0, 0.2, 0.0])), jnp.array([0.6, 0.0, 0.8]))
        >>> found = jl.multiview.planar_motion.planar_relative(points, T_first_second.inverse().apply(points))
        >>> error = jnp.abs(found.poses.translation - T_first_second.translation[None]).max(1)
        >>> bool((found.valid & (error < 1e-3)).any())
        True
    """
    first, second = (unit_rays(rays) for rays in (first, second))
    left, right = _sides(first, second)
    frozen = lax.stop_gradient((left, right))
    headings, good = _closed_form(*frozen)

    def pose(heading: Array, good: Array) -> tuple[SE3, Array]:
        heading = _polish(*frozen, heading)
        # The reversed translation satisfies the equations too.
        behind = _num_in_front(first, second, heading + jnp.pi) > _num_in_front(first, second, heading)
        heading = heading + jnp.where(behind, jnp.pi, 0.0).astype(heading.dtype)
        miss = jnp.max(jnp.abs(_equations(*frozen, heading)))
        step, isolated = _step(left, right, heading)
        valid = good & isolated & (miss < 1e2 * float(jnp.finfo(miss.dtype).eps))
        valid = valid & (_num_in_front(first, second, heading) == 2)
        heading = heading - jnp.where(valid, step, 0.0)
        sin, cos = jnp.sin(heading[0]), jnp.cos(heading[0])
        zero = jnp.zeros_like(sin)
        return SE3(SO3(_about_y(heading[0] - heading[1])), jnp.stack([sin, zero, cos])), valid

    poses, valid = jax.vmap(pose)(headings, good)
    distance = jnp.max(jnp.abs(lax.stop_gradient(poses.translation[0] - poses.translation[1])))
    rotated = jnp.abs(lax.stop_gradient(poses.rotation.rotation_matrix[0] - poses.rotation.rotation_matrix[1]))
    other = jnp.maximum(distance, jnp.max(rotated)) > 10.0 * float(jnp.finfo(distance.dtype).eps) ** 0.5
    return MinimalPoses(poses, valid & jnp.stack([jnp.array(True), other | ~valid[0]]))


def _sides(first: Array, second: Array) -> tuple[Float[Array, "2 2"], Float[Array, "2 2"]]:
    """Rows of ``A (cos p, sin p) + B (cos q, sin q) = 0``."""
    left = jnp.stack([-first[:, 0], first[:, 2]], axis=1) * second[:, 1:2]
    return left, jnp.stack([second[:, 0], -second[:, 2]], axis=1) * first[:, 1:2]


def _closed_form(left: Array, right: Array) -> tuple[Float[Array, "2 2"], Bool[Array, "2"]]:
    """Angles (p, q) of both candidates, up to half a turn of both, and whether they are real.

    ``det(A) (cos p, sin p) = -C (cos q, sin q)`` with ``C = adj(A) B``; equal lengths are a quadratic form in the
    second vector, ``m + r cos(2 q - d) = 0``.
    """
    (a, b), (c, d) = left
    determinant = a * d - b * c
    rows = jnp.stack([d * right[0] - b * right[1], a * right[1] - c * right[0]])
    gram = [jnp.sum(rows[:, i] * rows[:, j]) for i, j in ((0, 0), (0, 1), (1, 1))]
    middle, along, across = 0.5 * (gram[0] + gram[2]) - determinant**2, 0.5 * (gram[0] - gram[2]), gram[1]
    radius = jnp.sqrt(along * along + across * across)
    size = jnp.sum(left**2) * jnp.sum(right**2)
    tolerance = float(jnp.finfo(size.dtype).eps)
    regular = (jnp.abs(determinant) > 10.0 * tolerance * jnp.sum(left**2)) & (radius > 10.0 * tolerance * size)
    ratio = -middle / jnp.where(regular, radius, 1.0)
    real = regular & (jnp.abs(ratio) <= 1.0 + tolerance**0.5)
    half = 0.5 * jnp.arccos(jnp.clip(jnp.where(regular, ratio, 0.0), -1.0, 1.0))
    phase = 0.5 * jnp.arctan2(across, along)
    q = phase + jnp.stack([half, -half])
    image = -jnp.sign(determinant) * jnp.stack([r[0] * jnp.cos(q) + r[1] * jnp.sin(q) for r in rows])
    return jnp.stack([jnp.arctan2(image[1], image[0]), q], axis=1), jnp.stack([real, real])


def _equations(left: Array, right: Array, angles: Float[Array, "2"]) -> Float[Array, "2"]:
    cos, sin = jnp.cos(angles), jnp.sin(angles)
    return left[:, 0] * cos[0] + left[:, 1] * sin[0] + right[:, 0] * cos[1] + right[:, 1] * sin[1]


def _step(left: Array, right: Array, angles: Float[Array, "2"]) -> tuple[Float[Array, "2"], Bool[Array, ""]]:
    """Newton step with derivatives by the equations alone, and whether the solution is isolated."""
    cos, sin = jnp.cos(angles), jnp.sin(angles)
    by_p, by_q = left[:, 1] * cos[0] - left[:, 0] * sin[0], right[:, 1] * cos[1] - right[:, 0] * sin[1]
    by_p, by_q = lax.stop_gradient((by_p, by_q))
    determinant = by_p[0] * by_q[1] - by_p[1] * by_q[0]
    size = jnp.sum(by_p**2) + jnp.sum(by_q**2)
    isolated = jnp.abs(determinant) > 10.0 * float(jnp.finfo(size.dtype).eps) * size
    e = _equations(left, right, angles)
    step = jnp.stack([by_q[1] * e[0] - by_q[0] * e[1], by_p[0] * e[1] - by_p[1] * e[0]])
    return jnp.where(isolated, step, 0.0) / jnp.where(isolated, determinant, 1.0), isolated


def _polish(left: Array, right: Array, angles: Float[Array, "2"]) -> Float[Array, "2"]:
    def improve(_: Any, angles: Array) -> Array:
        return angles - jnp.clip(_step(left, right, angles)[0], -0.1, 0.1)

    return lax.fori_loop(0, _POLISH_STEPS, improve, angles)


def _about_y(angle: Float[Array, ""]) -> Float[Array, "3 3"]:
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    zero, one = jnp.zeros_like(cos), jnp.ones_like(cos)
    return jnp.stack([jnp.stack(row) for row in ((cos, zero, sin), (zero, one, zero), (-sin, zero, cos))])


def _num_in_front(first: Array, second: Array, angles: Float[Array, "2"]) -> Array:
    """Number of points in front of both cameras."""
    first, second, angles = lax.stop_gradient((first, second, angles))
    rotated = jnp.sum(_about_y(angles[0] - angles[1])[None] * second[:, None, :], axis=2)
    zero = jnp.zeros_like(angles[0])
    heading = jnp.stack([jnp.sin(angles[0]), zero, jnp.cos(angles[0])])
    return jnp.sum(jnp.all(depth_signs(heading, first, rotated) > 0, axis=0))
