"""Epipolar geometry of two views: essential and fundamental matrices, epipolar lines, epipoles and distances.

Convention: ``x1^T M x2 = 0`` for a point seen at ``x1`` by the first camera and at ``x2`` by the second.
With ``T_first_second = (R, t)``, the essential matrix is ``E = [t] R`` (OpenCV's and PoseLib's are its transpose), and
``F = K1^-T E K2^-1``.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxloc import _linalg
from jaxloc._arguments import checked
from jaxloc._jit import filter_jit
from jaxloc._linalg import matmul
from jaxloc.poses import SE3, SO3, Direction
from jaxloc.poses.lie_group import skew
from jaxloc.sensors import Pinhole
from jaxloc.solvers import Problem, Quadratic


class RelativePose(eqx.Module):
    """Pose of a second camera in the frame of the first, up to the length of the translation.

    The state has five degrees of freedom; steps in its tangent space keep the essential matrix on its manifold.

    Attributes:
        direction: of the translation, frame of the first camera.
        rotation: from the second camera's frame to the first's.
    """

    direction: Direction
    rotation: SO3

    @staticmethod
    @checked
    def of(pose: SE3) -> "RelativePose":
        """The rotation and direction of translation of a pose."""
        return RelativePose(Direction.from_vector(pose.translation), pose.rotation)

    def essential(self) -> Float[Array, "3 3"]:
        """``E = [t] R`` with singular values one, one and zero."""
        return matmul(skew(self.direction.vector), self.rotation.matrix())

    def pose(self, length: Any = 1.0) -> SE3:
        """``T_first_second`` with a translation of the given length, m."""
        return SE3(self.rotation, self.direction.vector * length)


@checked
def fundamental(essential: Float[Array, "3 3"], first: Pinhole, second: Pinhole) -> Float[Array, "3 3"]:
    """``F = K1^-T E K2^-1``, for undistorted pixels, of unit Frobenius norm.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> camera = jl.sensors.Pinhole(100.0, 100.0, 50.0, 50.0)
        >>> sideways = jl.poses.lie_group.skew(jnp.array([1.0, 0.0, 0.0]))
        >>> jl.multiview.epipolar.fundamental(sideways, camera, camera).round(2).tolist()[2]
        [0.0, 0.7099999785423279, 0.0]
    """
    inverse = [_linalg.inverse(camera.matrix()) for camera in (first, second)]
    matrix = matmul(inverse[0].T, matmul(essential, inverse[1]))
    squared = jnp.sum(matrix * matrix)
    return matrix / jnp.sqrt(jnp.where(squared > 0, squared, 1.0))


@checked
def homogeneous(points: Float[Array, "n 2"]) -> Float[Array, "3 n"]:
    """Homogeneous coordinates, points along the last axis."""
    return jnp.concatenate([points.T, jnp.ones_like(points.T[:1])])


@filter_jit
@checked
def epipolar_lines(matrix: Float[Array, "3 3"], second: Float[Array, "n 2"]) -> Float[Array, "n 3"]:
    """Lines ``a u + b v + c = 0`` of the first image on which points of the second lie; ``a^2 + b^2 = 1``.

    For lines of the second image give the transposed matrix and points of the first.

    References:
        Review eq. 20 [R-48]; thesis figure 2.3 [T-20].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> sideways = jl.poses.lie_group.skew(jnp.array([1.0, 0.0, 0.0]))
        >>> jl.multiview.epipolar.epipolar_lines(sideways, jnp.array([[5.0, 3.0]])).tolist()  # v = 3
        [[0.0, -1.0, 3.0]]
    """
    lines = matmul(matrix, homogeneous(second))
    squared = lines[0] ** 2 + lines[1] ** 2
    return (lines / jnp.sqrt(jnp.where(squared > 0, squared, 1.0))[None, :]).T


@filter_jit
@checked
def epipoles(matrix: Float[Array, "3 3"]) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """Images of each camera's center in the other view: unit homogeneous points with ``e1^T M = 0``, ``M e2 = 0``.

    Args:
        matrix: fundamental or essential, of rank two.

    Returns:
        The image of the second camera's center in the first image, and that of the first's in the second.

    References:
        Thesis figure 2.3 [T-20].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> ahead = jl.poses.lie_group.skew(jnp.array([0.0, 0.0, 1.0]))
        >>> [jnp.abs(e).round(3).tolist() for e in jl.multiview.epipolar.epipoles(ahead)]
        [[0.0, 0.0, 1.0], [0.0, 0.0, 1.0]]
    """
    return null_vector(matrix.T)[0], null_vector(matrix)[0]


@checked
def null_vector(matrix: Float[Array, "3 3"]) -> tuple[Float[Array, "3"], Bool[Array, ""]]:
    """Unit vector orthogonal to the rows of a matrix of rank two, and whether its rank is at least two.

    The largest of the rows' cross products, of a matrix of any scale; the third axis for a lower rank.
    """
    squared = jnp.sum(matrix * matrix)
    some = jnp.isfinite(squared) & (squared > 0)
    a, b, c = jnp.where(some, matrix, 0.0) / jnp.sqrt(jnp.where(some, squared, 1.0))
    products = jnp.stack([jnp.cross(a, b), jnp.cross(b, c), jnp.cross(c, a)])
    squares = jnp.sum(products * products, axis=1)
    best = jnp.argmax(squares)
    known = squares[best] > float(jnp.finfo(matrix.dtype).eps) ** 2
    vector = jnp.where(known, products[best], jnp.array([0.0, 0.0, 1.0], matrix.dtype))
    return vector / jnp.sqrt(jnp.where(known, squares[best], 1.0)), known


@checked
def unit_rays(rays: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Rays normalized to length one; zero where not finite."""
    rays = jnp.where(jnp.all(jnp.isfinite(rays), axis=1, keepdims=True), rays, 0.0)
    squared = jnp.sum(rays * rays, axis=1, keepdims=True)
    return rays / jnp.sqrt(jnp.where(squared > 0, squared, 1.0))


@checked
def depth_signs(
    direction: Float[Array, "3"], first: Float[Array, "n 3"], second: Float[Array, "n 3"]
) -> Float[Array, "2 n"]:
    """Numbers with the signs of the depths of the point nearest to both rays, along each of them.

    Args:
        direction: of the translation, frame of the first camera.
        first: rays of the first camera, of any length.
        second: rays of the second, rotated into the frame of the first.
    """
    normal, shift = jnp.cross(first, second), jnp.broadcast_to(direction, first.shape)
    return jnp.stack([jnp.sum(jnp.cross(shift, other) * normal, axis=1) for other in (second, first)])


@checked
def coplanarity(
    matrix: Float[Array, "3 3"], first: Float[Array, "n 2"], second: Float[Array, "n 2"]
) -> Float[Array, " n"]:
    """Epipolar constraint ``x1^T M x2``: volume spanned by both rays and the baseline; zero for rays that intersect.

    References:
        Longuet-Higgins 1981; review eq. 19, ``(P_l - T) . T x P_l = 0`` [R-47].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> sideways = jl.poses.lie_group.skew(jnp.array([1.0, 0.0, 0.0]))
        >>> jl.multiview.epipolar.coplanarity(sideways, jnp.array([[2.0, 3.0]]), jnp.array([[5.0, 3.0]])).tolist()
        [0.0]
    """
    return jnp.sum(homogeneous(first) * matmul(matrix, homogeneous(second)), axis=0)


def sampson_components(matrix: Array, x1: Float[Array, "3 n"], x2: Float[Array, "3 n"]) -> Float[Array, " n"]:
    """`sampson_distance` of homogeneous points along the last axis."""
    line1, line2 = matmul(matrix, x2), matmul(matrix.T, x1)
    error = jnp.sum(x1 * line1, axis=0)
    squared = line1[0] ** 2 + line1[1] ** 2 + line2[0] ** 2 + line2[1] ** 2
    some = squared > float(jnp.finfo(squared.dtype).tiny) ** 0.5
    return jnp.where(some, error, 0.0) / jnp.sqrt(jnp.where(some, squared, 1.0))


@filter_jit
@checked
def sampson_distance(
    matrix: Float[Array, "3 3"], first: Float[Array, "n 2"], second: Float[Array, "n 2"]
) -> Float[Array, " n"]:
    """Sampson distance: first-order geometric distance of pairs from the epipolar constraint, signed, in their unit.

    Args:
        matrix: fundamental (points in px) or essential (normalized coordinates).
        first: points of the first image.
        second: the corresponding points.

    References:
        Sampson 1982; Hartley and Zisserman, *Multiple View Geometry*, 2004, eq. 11.9 [R-48].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> sideways = jl.poses.lie_group.skew(jnp.array([1.0, 0.0, 0.0]))
        >>> off = jl.multiview.epipolar.sampson_distance(sideways, jnp.array([[2.0, 3.0]]), jnp.array([[5.0, 4.0]]))
        >>> round(abs(float(off[0])), 3)  # half a pixel each: sqrt(1/2) in all
        0.707
    """
    return sampson_components(matrix, homogeneous(first), homogeneous(second))


@filter_jit
@checked
def symmetric_distance(
    matrix: Float[Array, "3 3"], first: Float[Array, "n 2"], second: Float[Array, "n 2"]
) -> Float[Array, " n"]:
    """Root of the summed squared distances of both points from their epipolar lines.

    References:
        Hartley and Zisserman 2004, eq. 11.10.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> sideways = jl.poses.lie_group.skew(jnp.array([1.0, 0.0, 0.0]))
        >>> off = jl.multiview.epipolar.symmetric_distance(sideways, jnp.array([[2.0, 3.0]]), jnp.array([[5.0, 4.0]]))
        >>> round(float(off[0]), 3)
        1.414
    """
    lines = epipolar_lines(matrix, second), epipolar_lines(matrix.T, first)
    distances = [jnp.sum(homogeneous(p) * line.T, axis=0) for p, line in zip((first, second), lines, strict=True)]
    squared = distances[0] ** 2 + distances[1] ** 2
    some = squared > 0
    return jnp.where(some, jnp.sqrt(jnp.where(some, squared, 1.0)), 0.0)


@filter_jit
@checked
def epipolar_gate(
    matrix: Float[Array, "3 3"], first: Float[Array, "n 2"], second: Float[Array, "m 2"], *, band: Any = 2.0
) -> Bool[Array, "n m"]:
    """Pairs near each other's epipolar lines: a `gate` of `features.match.match`.

    Args:
        matrix: fundamental matrix.
        first: keypoints of the first image, px.
        second: keypoints of the second.
        band: greatest Sampson distance, px.

    Returns:
        True where the pair may match: the search is along a line instead of over the image [R-46].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> sideways = jl.poses.lie_group.skew(jnp.array([1.0, 0.0, 0.0]))
        >>> points = jnp.array([[2.0, 3.0], [7.0, 30.0]])
        >>> jl.multiview.epipolar.epipolar_gate(sideways, points, points[::-1]).tolist()
        [[False, True], [True, False]]
    """
    x1, x2 = homogeneous(first), homogeneous(second)
    line1, line2 = matmul(matrix, x2), matmul(matrix.T, x1)
    error = matmul(x1.T, line1)
    squared = (line1[0] ** 2 + line1[1] ** 2)[None, :] + (line2[0] ** 2 + line2[1] ** 2)[:, None]
    return error * error <= jnp.asarray(band, error.dtype) ** 2 * squared


class EpipolarError(Problem):
    """Least-squares problem of corresponding rays of two calibrated views; the state is the `RelativePose`.

    Attributes:
        first: "3 n", homogeneous normalized points of the first view; finite everywhere.
        second: "3 n", of the second.
        sigma: standard deviation of a coordinate, normalized: px over focal length.
        valid: pairs that are used.
        loss: robust kernel.
    """

    first: Float[Array, "3 n"]
    second: Float[Array, "3 n"]
    sigma: Float[Array, ""]
    valid: Bool[Array, " n"]
    loss: Any = Quadratic()

    def residual(self, state: RelativePose) -> Float[Array, "1 n"]:
        """Whitened Sampson distances."""
        error = sampson_components(state.essential(), self.first, self.second) / self.sigma
        return jnp.where(self.valid, error, 0.0)[None, :]
