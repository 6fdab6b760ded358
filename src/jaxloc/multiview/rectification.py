"""Two calibrated cameras turned, in their pictures, until rows show the same points."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxloc.poses import SE3, SO3
from jaxloc.poses.group import matmul, skew
from jaxloc.sensors import Pinhole, StereoRig


class Rectification(eqx.Module):
    """How a pair of pictures becomes one of a `StereoRig`.

    Attributes:
        rig: the rectified pair.
        R_rectified_left: rotation from the left camera's frame to the rectified one.
        R_rectified_right: rotation from the right camera's frame.
        ok: whether the right camera stands to the right of the left one; otherwise nothing is turned.
    """

    rig: StereoRig
    R_rectified_left: SO3
    R_rectified_right: SO3
    ok: Bool[Array, ""]


@eqx.filter_jit
def rectify(left: Pinhole, right: Pinhole, T_left_right: SE3, *, shape: tuple[int, int]) -> Rectification:
    """Turns two cameras so that epipoles lie at infinity and rows are equal.

    The rotation between the cameras is shared, half each; then both turn by the smallest rotation that brings the
    baseline onto the x axis. The new camera has the mean of the focal lengths, and a principal point that puts the
    middle of what both see into the middle of the picture.

    Args:
        left: the left camera.
        right: the right camera.
        T_left_right: pose of the right camera in the left one's frame.
        shape: (rows, columns) of the pictures.

    Returns:
        The rotations and the rig, without lens.

    References:
        Thesis figure 2.4 [T-21]; J.-Y. Bouguet's halves, as in OpenCV's ``stereoRectify``.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> camera = jl.sensors.Pinhole(500.0, 500.0, 319.5, 239.5)
        >>> pose = jl.poses.SE3.from_euler(jnp.array([0.2, 0.0, 0.0]), yaw=0.0, pitch=0.1, roll=0.0)
        >>> found = jl.multiview.rectification.rectify(camera, camera, pose, shape=(480, 640))
        >>> bool(found.ok), round(float(found.rig.baseline), 4)
        (True, 0.2)
    """
    half = SO3.exp(0.5 * T_left_right.rotation.log())
    # The baseline as the cameras see it once both have turned to the orientation between theirs.
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


@eqx.filter_jit
def lookup(camera: Pinhole, rotation: SO3, target: Pinhole, *, shape: tuple[int, int]) -> Float[Array, "h w 2"]:
    """Where each pixel of a rectified picture lies in the picture of the camera, lens included.

    Reading the picture there (`jaxloc.images.interpolation.sample`, or ``cv2.remap`` with the two components) rectifies
    it. With the identity for a rotation, only the lens is taken out [K-81].

    Args:
        camera: that took the picture.
        rotation: from its frame to the rectified one.
        target: the rectified camera.
        shape: (rows, columns) of the rectified picture.

    Returns:
        Pixels (u, v); (-1, -1), outside any picture, where the camera does not look or its lens is not one-to-one.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> camera = jl.sensors.Pinhole(50.0, 50.0, 2.0, 1.0)
        >>> jl.multiview.rectification.lookup(camera, jl.poses.SO3.identity(), camera, shape=(3, 5))[1, 4].tolist()
        [4.0, 1.0]
    """
    dtype = camera.fx.dtype
    v, u = jnp.meshgrid(jnp.arange(shape[0], dtype=dtype), jnp.arange(shape[1], dtype=dtype), indexing="ij")
    x, y = target.normalize_components(u, v)
    rays = jnp.stack([x, y, jnp.ones_like(x)]).reshape(3, -1)
    px, py, pz = matmul(rotation.rotation_matrix.T, rays)
    seen = camera.in_front_components(px, py, pz)
    u, v = camera.project_components(px, py, pz)
    found = jnp.where(seen[None, :], jnp.stack([u, v]), -1.0)
    return jnp.moveaxis(found.reshape(2, *shape), 0, -1)


def _onto_x(axis: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """The smallest rotation of a unit vector onto the x axis, smooth also where it is there."""
    zero = jnp.zeros_like(axis[0])
    cross = skew(jnp.stack([zero, axis[2], -axis[1]]))
    return jnp.eye(3, dtype=axis.dtype) + cross + matmul(cross, cross) / (1.0 + axis[0])


def _shift(camera: Pinhole, rotation: SO3, focal: Float[Array, ""], shape: tuple[int, int]) -> Float[Array, "2"]:
    """Principal point that brings the mean of some rays of a camera to the center of the rectified picture."""
    rows, columns = shape
    parts = jnp.asarray([0.25, 0.5, 0.75], camera.fx.dtype)
    u, v = jnp.meshgrid(parts * (columns - 1), parts * (rows - 1))
    x, y = camera.normalize_components(u.ravel(), v.ravel())
    px, py, pz = matmul(rotation.rotation_matrix, jnp.stack([x, y, jnp.ones_like(x)]))
    depth = jnp.where(pz > 0.1, pz, 0.1)
    middle = jnp.asarray([0.5 * (columns - 1), 0.5 * (rows - 1)], camera.fx.dtype)
    return middle - focal * jnp.stack([jnp.mean(px / depth), jnp.mean(py / depth)])
