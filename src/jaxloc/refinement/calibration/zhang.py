"""Zhang's closed-form calibration from homographies of a planar board: the initial value of `calibrate`.

It is not differentiated (the derivatives are those of the minimum), so that singular value decompositions are safe.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxloc import _linalg
from jaxloc._arguments import checked
from jaxloc._linalg import matmul
from jaxloc.multiview.homography import direct_linear_transform
from jaxloc.poses import SE3, SO3

_FEWEST_CORNERS = 6


class Views(NamedTuple):
    """Corners of a board in several images, finite everywhere.

    Attributes:
        board: "3 m", frame of the board, m; points along the last axis.
        pixels: "n 2 m".
        valid: corners that are used; none of a board with too few of them.
    """

    board: Float[Array, "3 m"]
    pixels: Float[Array, "n 2 m"]
    valid: Bool[Array, "n m"]

    def used(self) -> Bool[Array, " n"]:
        """Boards that are used."""
        return jnp.any(self.valid, axis=1)


def center_board(*sides: Views) -> tuple[Float[Array, "3"], tuple[Views, ...]]:
    """The mean of the corners that are used, and the views of the board in a frame there.

    Homographies, and the unknowns about a board's origin, are badly conditioned where it is far from its corners.
    """
    counts = sum(jnp.sum(side.valid, axis=0, dtype=side.board.dtype) for side in sides)
    center = jax.lax.stop_gradient(
        jnp.sum(sides[0].board * counts[None, :], axis=1) / jnp.maximum(jnp.sum(counts), 1.0)
    )
    return center, tuple(Views(side.board - center[:, None], side.pixels, side.valid) for side in sides)


class InitialCalibration(NamedTuple):
    """A camera without lens distortion, and the poses of the boards.

    Attributes:
        focal: (fx, fy), px.
        center: principal point, px.
        boards: poses ``T_camera_board``.
    """

    focal: Float[Array, "2"]
    center: Float[Array, "2"]
    boards: SE3


@checked
def finite_views(board: Float[Array, "m 3"], corners: Float[Array, "n m 2"], valid: Bool[Array, "n m"] | None) -> Views:
    """The views with non-finite corners masked and replaced."""
    finite = jnp.all(jnp.isfinite(corners), axis=2) & jnp.all(jnp.isfinite(board), axis=1)[None, :]
    used = finite if valid is None else finite & valid
    used = used & (jnp.sum(used, axis=1, keepdims=True) >= _FEWEST_CORNERS)
    pixels = jnp.where(used[:, :, None], corners, 0.0)
    return Views(jnp.where(jnp.isfinite(board), board, 0.0).T, jnp.swapaxes(pixels, 1, 2), used)


def extent(views: Views, shape: tuple[int, int] | None) -> tuple[Float[Array, "2"], Float[Array, ""]]:
    """Center of the images and half of their larger side, px: of the corners if no shape is given."""
    dtype = views.pixels.dtype
    if shape is not None:
        rows, columns = shape
        return jnp.asarray([0.5 * (columns - 1), 0.5 * (rows - 1)], dtype), jnp.asarray(0.5 * max(shape), dtype)
    used = views.valid[:, None, :]
    low = jnp.min(jnp.where(used, views.pixels, jnp.inf), axis=(0, 2))
    high = jnp.max(jnp.where(used, views.pixels, -jnp.inf), axis=(0, 2))
    some = jnp.any(views.valid)
    low, high = jnp.where(some, low, 0.0), jnp.where(some, high, 1.0)
    return 0.5 * (low + high), jnp.maximum(0.5 * jnp.max(high - low), 1.0)


@checked
def closed_form(views: Views, center: Float[Array, "2"], scale: Float[Array, ""]) -> InitialCalibration:
    """The best of three closed forms, by reprojection error.

    Zhang's linear equations for the image of the absolute conic: with the principal point unknown; with it at the
    center of the images; and with one focal length besides. The first is exact without noise and distortion, the last
    is the most robust.

    References:
        Zhang, "A flexible new technique for camera calibration", T-PAMI 2000, section 3.1 [T-17].
    """
    views, center, scale = jax.lax.stop_gradient((views, center, scale))
    matrices = jax.vmap(direct_linear_transform, (None, 0, 0))(views.board[:2], views.pixels, views.valid)
    used = views.used()
    normalize = _similarity(center, scale)
    conics = jnp.where(used[:, None, None], jax.vmap(lambda h: _unit(matmul(normalize, h)))(matrices), 0.0)
    candidates = [_zhang(conics), _centered(conics), _square(conics)]
    focals = jnp.stack([focal for focal, _ in candidates]) * scale
    centers = jnp.stack([shift for _, shift in candidates]) * scale + center[None, :]

    def attempt(focal: Array, point: Array) -> tuple[SE3, Array]:
        boards = jax.vmap(lambda h: _pose(h, focal, point))(matrices)
        return boards, _misfit(views, InitialCalibration(focal, point, boards))

    boards, costs = jax.vmap(attempt)(focals, centers)
    best = jnp.argmin(jnp.where(jnp.isfinite(costs), costs, jnp.inf))
    boards = jax.tree.map(lambda leaf: leaf[best], boards)
    rest = SE3.identity(center.dtype)
    boards = jax.tree.map(
        lambda leaf, idle: jnp.where(used.reshape(-1, *([1] * idle.ndim)), leaf, idle[None]), boards, rest
    )
    return InitialCalibration(focals[best], centers[best], boards)


def _similarity(center: Float[Array, "2"], scale: Float[Array, ""]) -> Float[Array, "3 3"]:
    zero, one = jnp.zeros_like(scale), jnp.ones_like(scale)
    rows = [[1.0 / scale, zero, -center[0] / scale], [zero, 1.0 / scale, -center[1] / scale], [zero, zero, one]]
    return jnp.stack([jnp.stack(row) for row in rows])


def _unit(matrix: Array) -> Array:
    return matrix / jnp.maximum(jnp.linalg.norm(matrix), jnp.finfo(matrix.dtype).tiny)


def _equations(conics: Float[Array, "n 3 3"]) -> Float[Array, "k 5"]:
    """Rows of ``h1' B h2 = 0`` and ``h1' B h1 = h2' B h2`` in (B11, B22, B13, B23, B33), without skew."""

    def product(a: Array, b: Array) -> Array:
        cross = a[:, 0] * b[:, 2] + a[:, 2] * b[:, 0], a[:, 1] * b[:, 2] + a[:, 2] * b[:, 1]
        return jnp.stack([a[:, 0] * b[:, 0], a[:, 1] * b[:, 1], *cross, a[:, 2] * b[:, 2]], axis=1)

    first, second = conics[:, :, 0], conics[:, :, 1]
    return jnp.concatenate([product(first, second), product(first, first) - product(second, second)])


def _root(value: Array) -> Array:
    """Square root; nan for negative values, so that this form is not chosen."""
    return jnp.where(value > 0, jnp.sqrt(jnp.where(value > 0, value, 1.0)), jnp.nan)


def _zhang(conics: Float[Array, "n 3 3"]) -> tuple[Float[Array, "2"], Float[Array, "2"]]:
    rows = _equations(conics)
    rows = jnp.concatenate([rows, jnp.zeros((5, 5), rows.dtype)])
    b11, b22, b13, b23, b33 = _linalg.svd(rows)[2][4]
    cx, cy = -b13 / b11, -b23 / b22
    size = b33 + cx * b13 + cy * b23
    return jnp.stack([_root(size / b11), _root(size / b22)]), jnp.stack([cx, cy])


def _centered(conics: Float[Array, "n 3 3"]) -> tuple[Float[Array, "2"], Float[Array, "2"]]:
    rows = _equations(conics)
    a, right = rows[:, :2], -rows[:, 4]
    m00, m01, m11 = jnp.sum(a[:, 0] ** 2), jnp.sum(a[:, 0] * a[:, 1]), jnp.sum(a[:, 1] ** 2)
    r0, r1 = jnp.sum(a[:, 0] * right), jnp.sum(a[:, 1] * right)
    determinant = m00 * m11 - m01 * m01
    solution = jnp.stack([m11 * r0 - m01 * r1, m00 * r1 - m01 * r0]) / determinant
    return _root(1.0 / solution), jnp.zeros(2, rows.dtype)


def _square(conics: Float[Array, "n 3 3"]) -> tuple[Float[Array, "2"], Float[Array, "2"]]:
    """One focal length; that of a field of view of 53 degrees where this fails."""
    rows = _equations(conics)
    a, right = rows[:, 0] + rows[:, 1], -rows[:, 4]
    inverse = jnp.sum(a * right) / jnp.sum(a * a)
    focal = _root(1.0 / inverse)
    focal = jnp.where((focal > 0.1) & (focal < 100.0), focal, 2.0)
    return jnp.stack([focal, focal]), jnp.zeros(2, rows.dtype)


def _pose(matrix: Float[Array, "3 3"], focal: Float[Array, "2"], center: Float[Array, "2"]) -> SE3:
    """``T_camera_board`` of a homography ``K [r1 r2 t]``, the board in front of the camera."""
    h = (matrix - center_rows(matrix, center)) / jnp.concatenate([focal, jnp.ones(1, focal.dtype)])[:, None]
    size = 0.5 * (jnp.linalg.norm(h[:, 0]) + jnp.linalg.norm(h[:, 1]))
    size = jnp.where(h[2, 2] < 0, -size, size)
    h = h / jnp.where(jnp.abs(size) > 0, size, 1.0)
    rotation = jnp.stack([h[:, 0], h[:, 1], jnp.cross(h[:, 0], h[:, 1])], axis=1)
    good = jnp.all(jnp.isfinite(rotation)) & jnp.all(jnp.isfinite(h))
    eye = jnp.eye(3, dtype=h.dtype)
    left, _, right = _linalg.svd(jnp.where(good, rotation, eye))
    turned = matmul(left, right)
    turned = jnp.where(jnp.linalg.det(turned) > 0, turned, eye)
    return SE3(SO3(turned), jnp.where(good, h[:, 2], 0.0))


@checked
def center_rows(matrix: Float[Array, "3 3"], center: Float[Array, "2"]) -> Float[Array, "3 3"]:
    """Rows of a homography relative to a principal point."""
    return jnp.concatenate([center[:, None] * matrix[2:], jnp.zeros((1, 3), matrix.dtype)])


def _misfit(views: Views, initial: InitialCalibration) -> Float[Array, ""]:
    """Root mean square of the pixel errors, infinite where a corner lies behind the camera."""

    def error(pose: SE3, pixels: Array, valid: Array) -> Array:
        x, y, z = matmul(pose.rotation.matrix(), views.board) + pose.translation[:, None]
        in_front = z > 0
        depth = jnp.where(in_front, z, 1.0)
        predicted = jnp.stack([x / depth, y / depth]) * initial.focal[:, None] + initial.center[:, None]
        squared = jnp.where(in_front, jnp.sum((predicted - pixels) ** 2, axis=0), jnp.inf)
        return jnp.sum(jnp.where(valid, squared, 0.0))

    return jnp.sum(jax.vmap(error)(initial.boards, views.pixels, views.valid))
