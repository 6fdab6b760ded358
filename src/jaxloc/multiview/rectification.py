"""Stereo rectification: of calibrated pairs by rotations, of uncalibrated ones by homographies."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxloc._arguments import checked
from jaxloc._jit import filter_jit
from jaxloc._linalg import matmul
from jaxloc.beliefs.validity import positive
from jaxloc.images import Homography
from jaxloc.multiview.epipolar import null_vector
from jaxloc.poses import SE3, SO3
from jaxloc.poses.lie_group import skew
from jaxloc.sensors import Pinhole, StereoRig
from jaxloc.solvers.cholesky import factor
from jaxloc.solvers.estimate import guarded


class Rectification(eqx.Module):
    """Rotations that rectify a pair of cameras, and the rectified `StereoRig`.

    Attributes:
        rig: the rectified pair.
        R_rectified_left: rotation from the left camera's frame to the rectified one.
        R_rectified_right: rotation from the right camera's frame.
        ok: whether the right camera is to the right of the left one; otherwise the rotations are the identity.
    """

    rig: StereoRig
    R_rectified_left: SO3
    R_rectified_right: SO3
    ok: Bool[Array, ""]


@filter_jit
@checked
def rectify(left: Pinhole, right: Pinhole, T_left_right: SE3, *, shape: tuple[int, int]) -> Rectification:
    """Rectifies two calibrated cameras: epipoles at infinity, corresponding points in equal rows.

    Each camera is rotated by half of the rotation between them; then both by the smallest rotation that brings the
    baseline onto the x axis. The new camera has the mean of the focal lengths, and a principal point that puts the
    center of the common field of view into the center of the image.

    Args:
        left: the left camera.
        right: the right camera.
        T_left_right: pose of the right camera in the left one's frame.
        shape: (rows, columns) of the images.

    Returns:
        The rotations and the rig without lens distortion.

    References:
        Thesis figure 2.4 [T-21]; J.-Y. Bouguet's method, as in OpenCV's ``stereoRectify``.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> camera = jl.sensors.Pinhole(500.0, 500.0, 319.5, 239.5)
        >>> pose = jl.poses.SE3.from_euler(jnp.array([0.2, 0.0, 0.0]), yaw=0.0, pitch=0.1, roll=0.0)
        >>> found = jl.multiview.rectification.rectify(camera, camera, pose, shape=(480, 640))
        >>> bool(found.ok), round(float(found.rig.baseline), 4)
        (True, 0.2)
    """
    usable = positive(left.fx) & positive(left.fy) & positive(right.fx) & positive(right.fy)
    return guarded(usable, lambda *cameras: _rectify(*cameras, shape), left, right, T_left_right)


def _rectify(left: Pinhole, right: Pinhole, T_left_right: SE3, shape: tuple[int, int]) -> Rectification:
    half = SO3.exp(0.5 * T_left_right.rotation.log())
    # The baseline in the frame of the mean orientation of both cameras.
    between = half.inverse().apply(T_left_right.translation[None])[0]
    squared = jnp.sum(between**2)
    length = jnp.sqrt(jnp.where(squared > 0, squared, 1.0))
    axis = between / length
    ok = jnp.isfinite(squared) & (squared > 0) & (axis[0] > 0.5)
    axis = jnp.where(ok, axis, jnp.array([1.0, 0.0, 0.0], axis.dtype))
    eye = jnp.eye(3, dtype=axis.dtype)
    half = SO3(jnp.where(ok, half.rotation_matrix, eye))
    turn = SO3(_onto_x(axis))
    rotations = turn @ half.inverse(), turn @ half
    focal = 0.25 * (left.fx + left.fy + right.fx + right.fy)
    center = 0.5 * sum(_shift(c, r, focal, shape) for c, r in zip((left, right), rotations, strict=True))
    rig = StereoRig(Pinhole(focal, focal, center[0], center[1]), jnp.where(ok, length, 1.0))
    return Rectification(rig, *rotations, ok)


@filter_jit
@checked
def rectification_map(
    camera: Pinhole, rotation: SO3, target: Pinhole, *, shape: tuple[int, int]
) -> Float[Array, "h w 2"]:
    """Rectification map: for each pixel of a rectified image, its pixel in the (distorted) image of the camera.

    Sampling the image there (`jaxloc.images.interpolation.sample`, or ``cv2.remap`` with the two components) rectifies
    it. With the identity as rotation it only undistorts [K-81].

    Args:
        camera: camera of the image.
        rotation: from the camera's frame to the rectified one.
        target: the rectified camera.
        shape: (rows, columns) of the rectified image.

    Returns:
        Pixels (u, v); (-1, -1), outside any image, where the ray is not in the camera's field of view.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> camera = jl.sensors.Pinhole(50.0, 50.0, 2.0, 1.0)
        >>> identity = jl.poses.SO3.identity()
        >>> jl.multiview.rectification.rectification_map(camera, identity, camera, shape=(3, 5))[1, 4].tolist()
        [4.0, 1.0]
    """
    dtype = camera.fx.dtype
    v, u = jnp.meshgrid(jnp.arange(shape[0], dtype=dtype), jnp.arange(shape[1], dtype=dtype), indexing="ij")
    x, y = target.normalize_components(u, v)
    rays = jnp.stack([x, y, jnp.ones_like(x)]).reshape(3, -1)
    px, py, pz = matmul(rotation.rotation_matrix.T, rays)
    visible = camera.in_front_components(px, py, pz)
    u, v = camera.project_components(px, py, pz)
    found = jnp.where(visible[None, :], jnp.stack([u, v]), -1.0)
    return jnp.moveaxis(found.reshape(2, *shape), 0, -1)


class RectifyingPair(eqx.Module):
    """Homographies of two images to a rectified pair.

    Attributes:
        first: from pixels of the first image to its rectified ones.
        second: of the second image.
        ok: False when an epipole lies within the image.
    """

    first: Homography
    second: Homography
    ok: Bool[Array, ""]


@filter_jit
@checked
def rectifying_homographies(
    fundamental: Float[Array, "3 3"],
    first: Float[Array, "n 2"],
    second: Float[Array, "n 2"],
    *,
    shape: tuple[int, int],
    valid: Bool[Array, " n"] | None = None,
) -> RectifyingPair:
    """Rectifying homographies of an uncalibrated pair with known fundamental matrix.

    The map of the second image moves its epipole to infinity along x with least distortion at its center; that of the
    first makes corresponding rows equal and, with its remaining freedom, minimizes the differences of columns.

    Args:
        fundamental: F with ``x1^T F x2 = 0``, px.
        first: points of the first image, px.
        second: the corresponding points.
        shape: (rows, columns) of the images.
        valid: pairs that are used.

    Returns:
        The two maps; the identity where ``ok`` is False.

    References:
        Hartley, "Theory and practice of projective rectification", IJCV 1999; thesis figure 2.4 [T-21].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> sideways = jnp.array([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
        >>> points = jnp.array([[10.0, 20.0], [50.0, 30.0], [30.0, 70.0], [80.0, 80.0]])
        >>> partners = points - jnp.array([[5.0, 0.0]])
        >>> pair = jl.multiview.rectification.rectifying_homographies(sideways, points, partners, shape=(100, 100))
        >>> bool(pair.ok), bool(jnp.allclose(pair.second.matrix(), jnp.eye(3), atol=1e-4))
        (True, True)
    """
    given = fundamental, first, second, valid
    return guarded(jnp.array(True), lambda *given: _rectifying_homographies(*given, shape), *given)


def _rectifying_homographies(
    fundamental: Array, first: Array, second: Array, valid: Any, shape: tuple[int, int]
) -> RectifyingPair:
    finite = jnp.all(jnp.isfinite(first), axis=1) & jnp.all(jnp.isfinite(second), axis=1)
    weight = (finite if valid is None else finite & valid).astype(first.dtype)
    first, second = (jnp.where(weight[:, None] > 0, points, 0.0) for points in (first, second))
    matrix = jnp.where(jnp.isfinite(fundamental), fundamental, 0.0)
    epipole, unique = null_vector(matrix)
    of_second, outside = _to_infinity(epipole, shape)
    # A matrix with F^T = [e] M maps epipolar lines.
    transfer = matmul(skew(epipole), _unit(matrix.T)) + epipole[:, None] * jnp.ones((1, 3), epipole.dtype)
    moved = matmul(of_second, transfer)
    x, target = _transferred(moved, first), _transferred(of_second, second)[0]
    normal = matmul(x * weight[None, :], x.T)
    row = factor(normal).solve(matmul(x * weight[None, :], target))
    of_first = jnp.concatenate([matmul(row[None, :], moved), moved[1:]])
    regular = jnp.abs(jnp.linalg.det(_unit(of_first))) > float(jnp.finfo(row.dtype).eps)
    ok = unique & outside & regular & (jnp.sum(weight) >= 3) & jnp.all(jnp.isfinite(of_first))
    eye = jnp.eye(3, dtype=row.dtype)
    return RectifyingPair(*(Homography.from_matrix(jnp.where(ok, h, eye)) for h in (of_first, of_second)), ok)


def _unit(matrix: Array) -> Array:
    squared = jnp.sum(matrix * matrix)
    return matrix / jnp.sqrt(jnp.where(squared > 0, squared, 1.0))


def _to_infinity(epipole: Float[Array, "3"], shape: tuple[int, int]) -> tuple[Float[Array, "3 3"], Bool[Array, ""]]:
    """Homography that moves a point to infinity along x and is near the identity at the image's center."""
    middle = jnp.asarray([0.5 * (shape[1] - 1), 0.5 * (shape[0] - 1)], epipole.dtype)
    zero, one = jnp.zeros_like(epipole[0]), jnp.ones_like(epipole[0])

    def matrix(*rows: tuple) -> Array:
        return jnp.stack([jnp.stack(row) for row in rows])

    x, y = epipole[0] - middle[0] * epipole[2], epipole[1] - middle[1] * epipole[2]
    # Of the two signs of the homogeneous point, the one to the right: a rotation of less than 90 degrees.
    sign = jnp.where(x < 0, -1.0, 1.0).astype(x.dtype)
    squared = x * x + y * y
    length = jnp.sqrt(jnp.where(squared > 0, squared, 1.0))
    cos, sin = sign * x / length, -sign * y / length
    slope = -sign * epipole[2] / length
    outside = (squared > 0) & (jnp.abs(slope) * 0.5 * max(shape) < 1.0)
    center = matrix((one, zero, -middle[0]), (zero, one, -middle[1]), (zero, zero, one))
    turn = matrix((cos, -sin, zero), (sin, cos, zero), (zero, zero, one))
    projective = matrix((one, zero, zero), (zero, one, zero), (slope, zero, one))
    back = matrix((one, zero, middle[0]), (zero, one, middle[1]), (zero, zero, one))
    return matmul(back, matmul(projective, matmul(turn, center))), outside


def _transferred(matrix: Float[Array, "3 3"], points: Float[Array, "n 2"]) -> Float[Array, "3 n"]:
    x, y, w = matmul(matrix[:, :2], points.T) + matrix[:, 2:]
    safe = jnp.where(w == 0, 1.0, w)
    return jnp.stack([x / safe, y / safe, jnp.ones_like(w)])


def _onto_x(axis: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """The smallest rotation of a unit vector onto the x axis, smooth at the x axis too."""
    zero = jnp.zeros_like(axis[0])
    cross = skew(jnp.stack([zero, axis[2], -axis[1]]))
    return jnp.eye(3, dtype=axis.dtype) + cross + matmul(cross, cross) / (1.0 + axis[0])


def _shift(camera: Pinhole, rotation: SO3, focal: Float[Array, ""], shape: tuple[int, int]) -> Float[Array, "2"]:
    """Principal point that maps the mean of some rays of a camera to the center of the rectified image."""
    rows, columns = shape
    parts = jnp.asarray([0.25, 0.5, 0.75], camera.fx.dtype)
    u, v = jnp.meshgrid(parts * (columns - 1), parts * (rows - 1))
    x, y = camera.normalize_components(u.ravel(), v.ravel())
    px, py, pz = matmul(rotation.rotation_matrix, jnp.stack([x, y, jnp.ones_like(x)]))
    depth = jnp.where(pz > 0.1, pz, 0.1)
    middle = jnp.asarray([0.5 * (columns - 1), 0.5 * (rows - 1)], camera.fx.dtype)
    return middle - focal * jnp.stack([jnp.mean(px / depth), jnp.mean(py / depth)])
