"""Simulated stereo measurements of points along a drive, without images, for drift and consistency tests."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from jaxloc._jit import filter_jit
from jaxloc.poses import SE3, Trajectory, chain
from jaxloc.sensors import Pinhole, StereoRig

_KITTI_SIZE = (376, 1241)
_NEAREST, _FARTHEST = 4.0, 60.0
_FRAME_RATE = 10.0


class StereoPairs(eqx.Module):
    """Matched stereo measurements of two successive frames (or a stack of such pairs along a leading axis).

    Args:
        previous: (u_left, u_right, v) in the first frame, px.
        current: (u_left, u_right, v) in the second frame, px.
        is_inlier: whether the match is true.
        motion: the true ``T_previous_current``.
    """

    previous: Float[Array, "*k n 3"]
    current: Float[Array, "*k n 3"]
    is_inlier: Bool[Array, "*k n"]
    motion: SE3


class StereoDrive(eqx.Module):
    """A drive with its stereo measurements.

    Args:
        pairs: one stacked pair for each motion between successive frames.
        truth: the true path, one pose more than there are pairs.
    """

    pairs: StereoPairs
    truth: Trajectory


def kitti_rig() -> StereoRig:
    """The gray cameras of KITTI odometry sequence 00; their images have 376 rows of 1241 pixels.

    Returns:
        The rig.

    References:
        Geiger, Lenz and Urtasun, "Are we ready for autonomous driving?", CVPR 2012.

    Example:
        >>> round(float(kitti_rig().baseline), 3)
        0.537
    """
    return StereoRig(Pinhole(718.856, 718.856, 607.1928, 185.2157), 386.1448 / 718.856)


@filter_jit
def simulate_drive(num_frames: int, *, key: Key[Array, ""], speed: float = 10.0) -> Trajectory:
    """Simulates the path of a camera on a car: about a meter a frame, in bends, with a little pitch, roll and heave.

    The rates are sums of slow sinusoids with random phases.

    Args:
        num_frames: number of poses, at 10 frames a second.
        key: random key.
        speed: m/s.

    Returns:
        Poses ``T_world_camera`` (x right, y down, z forward); the first is the identity.

    Example:
        >>> path = simulate_drive(50, key=jax.random.key(0))
        >>> len(path), bool(path.length() > 40)
        (50, True)
    """
    dtype = jnp.zeros(()).dtype
    times = jnp.arange(num_frames, dtype=dtype) / _FRAME_RATE
    periods = jnp.array([23.0, 11.0, 3.1], dtype)
    phases = jax.random.uniform(key, (6, 3), dtype, maxval=2.0 * jnp.pi)
    waves = jnp.mean(jnp.sin(2.0 * jnp.pi * times[:-1, None, None] / periods[None, None] + phases[None]), axis=2)
    # A frame's change of (x, y, z) in m and about (x, y, z) in rad.
    amplitudes = jnp.array([0.01, 0.02, 0.2 * speed / _FRAME_RATE, 0.004, 0.045, 0.003], dtype)
    twists = waves * amplitudes[None] + jnp.array([0.0, 0.0, speed / _FRAME_RATE, 0.0, 0.0, 0.0], dtype)[None]
    return Trajectory(times, chain(SE3.identity(dtype), jax.vmap(SE3.exp)(twists)))


@filter_jit
def simulate_pair(
    motion: SE3,
    rig: StereoRig,
    *,
    key: Key[Array, ""],
    num_points: int = 300,
    size: tuple[int, int] = _KITTI_SIZE,
    noise: float | Float[Array, ""] = 0.5,
    outlier_fraction: float | Float[Array, ""] = 0.25,
) -> StereoPairs:
    """Simulates what a stereo rig measures of the same points before and after a motion.

    Points are drawn uniformly over the second image and uniformly in inverse depth between 4 and 60 m. Every coordinate
    gets Gaussian noise. A wrong match is a random place and disparity in the second frame.

    Args:
        motion: ``T_previous_current``.
        rig: the cameras.
        key: random key.
        num_points: number of matches.
        size: height and width of an image, px.
        noise: standard deviation of u_left, u_right and v in each frame, px.
        outlier_fraction: probability that a match is wrong.

    Returns:
        The matches of one pair of frames.

    Example:
        >>> pair = simulate_pair(SE3.identity(), kitti_rig(), key=jax.random.key(0), noise=0.0, outlier_fraction=0.0)
        >>> bool(jnp.allclose(pair.previous, pair.current, atol=1e-2))
        True
    """
    place, wrong_place, before, after, choose = jax.random.split(key, 5)
    dtype = rig.camera.fx.dtype
    current = _draw_measurements(place, rig, num_points, size)
    previous = rig.project(motion.apply(rig.triangulate(current)))
    wrong = _draw_measurements(wrong_place, rig, num_points, size)
    is_inlier = jax.random.uniform(choose, (num_points,), dtype) >= outlier_fraction
    shape = (num_points, 3)
    return StereoPairs(
        previous=previous + noise * jax.random.normal(before, shape, dtype),
        current=jnp.where(is_inlier[:, None], current, wrong) + noise * jax.random.normal(after, shape, dtype),
        is_inlier=is_inlier,
        motion=motion,
    )


def _draw_measurements(key: Key[Array, ""], rig: StereoRig, count: int, size: tuple[int, int]) -> Float[Array, "n 3"]:
    u, v, nearness = jax.random.uniform(key, (3, count), rig.camera.fx.dtype)
    height, width = size
    u, v = u * (width - 1.0), v * (height - 1.0)
    inverse_depth = 1.0 / _FARTHEST + nearness * (1.0 / _NEAREST - 1.0 / _FARTHEST)
    return jnp.stack([u, u - rig.camera.fx * rig.baseline * inverse_depth, v], axis=1)


@filter_jit
def simulate_stereo_points(
    *,
    key: Key[Array, ""],
    rig: StereoRig | None = None,
    num_frames: int = 600,
    num_points: int = 300,
    size: tuple[int, int] = _KITTI_SIZE,
    noise: float | Float[Array, ""] = 0.5,
    outlier_fraction: float | Float[Array, ""] = 0.25,
) -> StereoDrive:
    """Simulates a drive and the stereo matches between its successive frames.

    Args:
        key: random key.
        rig: the cameras; :func:`kitti_rig` where not given.
        num_frames: number of poses.
        num_points: matches of a pair.
        size: height and width of an image, px.
        noise: standard deviation of u_left, u_right and v in each frame, px.
        outlier_fraction: probability that a match is wrong.

    Returns:
        The drive, with ``num_frames - 1`` stacked pairs.

    Example:
        >>> drive = simulate_stereo_points(key=jax.random.key(0), num_frames=4, num_points=20)
        >>> drive.pairs.previous.shape, len(drive.truth)
        ((3, 20, 3), 4)
    """
    rig = kitti_rig() if rig is None else rig
    path_key, pairs_key = jax.random.split(key)
    truth = simulate_drive(num_frames, key=path_key)
    if truth.times.dtype != rig.camera.fx.dtype:
        raise TypeError(
            f"The rig came in {rig.camera.fx.dtype}, the path is made in {truth.times.dtype}: make the rig after "
            "jax_enable_x64 is set."
        )

    def pair(motion: SE3, key: Key[Array, ""]) -> StereoPairs:
        return simulate_pair(
            motion, rig, key=key, num_points=num_points, size=size, noise=noise, outlier_fraction=outlier_fraction
        )

    return StereoDrive(jax.vmap(pair)(truth.relative(), jax.random.split(pairs_key, num_frames - 1)), truth)
