"""Pinhole camera model with lens distortion: projection and unprojection."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxloc._arguments import checked
from jaxloc._jit import filter_jit
from jaxloc._linalg import matmul
from jaxloc.poses import SE3
from jaxloc.poses.lie_group import as_floats
from jaxloc.sensors.lenses import Lens

_NEAREST = 1e-6  # least depth of points that are projected, m


class Pinhole(eqx.Module):
    """A central camera: ``u = fx x_d + skew y_d + cx``, ``v = fy y_d + cy``, ``(x_d, y_d) = lens(x/z, y/z)``.

    Camera axes: x right, y down, z forward. Every intrinsic is an array leaf and can be learned.

    Args:
        fx: focal length along the rows, px.
        fy: focal length along the columns, px.
        cx: column of the principal point, px (pixel centers lie at integers).
        cy: row of the principal point, px.
        skew: shear of the pixel grid, px.
        lens: distortion of the normalized coordinates, or None.

    References:
        Hartley and Zisserman, *Multiple View Geometry*, 2004, section 6.1 [T-13], [T-14], [T-15], [T-16].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> camera = jl.sensors.Pinhole(500.0, 500.0, 320.0, 240.0)
        >>> camera.project(jnp.array([[1.0, 0.5, 10.0]])).tolist()
        [[370.0, 265.0]]
    """

    fx: Float[Array, ""]
    fy: Float[Array, ""]
    cx: Float[Array, ""]
    cy: Float[Array, ""]
    skew: Float[Array, ""]
    lens: Lens | None

    def __init__(self, fx: Any, fy: Any, cx: Any, cy: Any, skew: Any = 0.0, lens: Lens | None = None):
        self.fx, self.fy, self.cx, self.cy, self.skew = as_floats(fx, fy, cx, cy, skew)
        self.lens = lens

    @staticmethod
    @checked
    def from_matrix(matrix: Float[Array, "3 3"], lens: Lens | None = None) -> "Pinhole":
        """Camera of an upper triangular intrinsic matrix [T-15]."""
        scaled = matrix / matrix[2, 2]
        return Pinhole(scaled[0, 0], scaled[1, 1], scaled[0, 2], scaled[1, 2], scaled[0, 1], lens)

    def matrix(self) -> Float[Array, "3 3"]:
        """Intrinsic matrix ``[[fx, skew, cx], [0, fy, cy], [0, 0, 1]]`` [T-15]."""
        zero, one = jnp.zeros_like(self.fx), jnp.ones_like(self.fx)
        rows = [[self.fx, self.skew, self.cx], [zero, self.fy, self.cy], [zero, zero, one]]
        return jnp.stack([jnp.stack(row) for row in rows])

    @checked
    def projection_matrix(self, T_world_camera: SE3) -> Float[Array, "3 4"]:
        """``K [R^T, -R^T t]``: homogeneous world points to homogeneous pixels of the camera without its lens [T-19]."""
        return matmul(self.matrix(), T_world_camera.inverse().matrix()[:3])

    @filter_jit
    @checked
    def project(self, points: Float[Array, "n 3"]) -> Float[Array, "n 2"]:
        """Pixels of points in the camera frame.

        Args:
            points: "n 3", camera frame, m.

        Returns:
            Pixels "n 2" (u right, v down). A point that is not in front of the camera gets the principal point, with
            zero gradient: mask it by `in_front`.
        """
        return jnp.stack(self.project_components(points[:, 0], points[:, 1], points[:, 2]), axis=-1)

    def project_components(
        self, x: Float[Array, "*n"], y: Float[Array, "*n"], z: Float[Array, "*n"]
    ) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
        """`project` on component arrays of any shape: solvers keep points along the last axis."""
        front = z > _NEAREST
        inverse = 1.0 / jnp.where(front, z, 1.0)
        x, y = jnp.where(front, x, 0.0) * inverse, jnp.where(front, y, 0.0) * inverse
        if self.lens is not None:
            x, y = self.lens.distort(x, y)
        return self.fx * x + self.skew * y + self.cx, self.fy * y + self.cy

    @filter_jit
    @checked
    def in_front(self, points: Float[Array, "n 3"]) -> Bool[Array, " n"]:
        """Whether points are projected: in front of the camera and where its lens is one-to-one."""
        return self.in_front_components(points[:, 0], points[:, 1], points[:, 2])

    def in_front_components(
        self, x: Float[Array, "*n"], y: Float[Array, "*n"], z: Float[Array, "*n"]
    ) -> Bool[Array, "*n"]:
        """`in_front` on component arrays."""
        front = z > _NEAREST
        if self.lens is None:
            return front
        inverse = 1.0 / jnp.where(front, z, 1.0)
        return front & self.lens.in_domain(x * inverse, y * inverse)

    def normalize_components(
        self, u: Float[Array, "*n"], v: Float[Array, "*n"]
    ) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
        """Pixels to undistorted normalized coordinates (x/z, y/z), on component arrays."""
        y = (v - self.cy) / self.fy
        x = (u - self.cx - self.skew * y) / self.fx
        return (x, y) if self.lens is None else self.lens.undistort(x, y)

    @filter_jit
    @checked
    def normalize(self, pixels: Float[Array, "n 2"]) -> Float[Array, "n 2"]:
        """Undistorted normalized coordinates (x/z, y/z) of pixels [T-16]."""
        return jnp.stack(self.normalize_components(pixels[:, 0], pixels[:, 1]), axis=-1)

    @filter_jit
    @checked
    def bearing(self, pixels: Float[Array, "n 2"]) -> Float[Array, "n 3"]:
        """Unit rays "n 3" of the camera frame through pixels "n 2"."""
        x, y = self.normalize_components(pixels[:, 0], pixels[:, 1])
        scale = 1.0 / jnp.sqrt(x * x + y * y + 1.0)
        return jnp.stack([x * scale, y * scale, scale], axis=-1)

    @filter_jit
    @checked
    def unproject(self, pixels: Float[Array, "n 2"], depth: Float[Array, " n"]) -> Float[Array, "n 3"]:
        """Points of the camera frame at pixels.

        Args:
            pixels: "n 2" (u, v).
            depth: "n", distance along the optical axis (z), m.

        Returns:
            Points "n 3", camera frame, m.
        """
        x, y = self.normalize_components(pixels[:, 0], pixels[:, 1])
        return jnp.stack([x * depth, y * depth, depth], axis=-1)


@checked
def kelly_matrix(focal: Float[Array, ""]) -> Float[Array, "4 4"]:
    """Projection matrix with ``1/f`` in its last row and a row of zeros for depth [K-8].

    The optical axis is **y**, the image plane is y = 0 and the center of projection lies at y = -f.

    References:
        A. Kelly, *Mobile Robotics*, lecture 9.2.1.2.1.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> jl.sensors.camera.kelly_matrix(jnp.array(0.5))[3].tolist()
        [0.0, 2.0, 0.0, 1.0]
    """
    one, zero = jnp.ones_like(focal), jnp.zeros_like(focal)
    rows = [[one, zero, zero, zero], [zero] * 4, [zero, zero, one, zero], [zero, one / focal, zero, one]]
    return jnp.stack([jnp.stack(row) for row in rows])


@filter_jit
@checked
def kelly_projection(points: Float[Array, "n 3"], focal: Float[Array, ""]) -> Float[Array, "n 2"]:
    """Image points ``(f x / (f + y), f z / (f + y))`` of points in a frame whose y axis is the optical axis [K-8].

    Args:
        points: "n 3", camera frame with y forward, m.
        focal: focal length, m.

    Returns:
        Image points "n 2" (x right, z up), m; zero for points that are not in front of the center of projection.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> jl.sensors.camera.kelly_projection(jnp.array([[1.0, 3.0, 2.0]]), jnp.array(1.0)).tolist()
        [[0.25, 0.5]]
    """
    depth = points[:, 1] + focal
    front = depth > _NEAREST
    gain = jnp.where(front, focal / jnp.where(front, depth, 1.0), 0.0)
    return jnp.stack([gain * points[:, 0], gain * points[:, 2]], axis=-1)


@filter_jit
@checked
def kelly_camera(
    T_world_camera: SE3, points_world: Float[Array, "n 3"], focal: Float[Array, ""]
) -> Float[Array, "n 2"]:
    """The complete camera model ``x = P T(rho) X = h(rho, X)`` [K-9].

    Args:
        T_world_camera: pose of the camera, whose y axis is the optical axis.
        points_world: "n 3", world frame, m.
        focal: focal length, m.

    Returns:
        Image points "n 2" (x right, z up), m.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> pose = jl.poses.SE3.from_euler(jnp.array([0.0, 1.0, 0.0]), yaw=0.0, pitch=0.0, roll=0.0)
        >>> jl.sensors.camera.kelly_camera(pose, jnp.array([[1.0, 4.0, 2.0]]), jnp.array(1.0)).tolist()
        [[0.25, 0.5]]
    """
    return kelly_projection(T_world_camera.inverse().apply(points_world), focal)
