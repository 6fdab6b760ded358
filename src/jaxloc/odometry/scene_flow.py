"""Scene flow of moving points: positions and velocities from two stereo frames with known camera motion.

What the motion of the camera explains is taken out first; only the rest is matched again, by small patches in a window
that is wide enough for oncoming cars, so that the cost is that of what moves and not of what stands.
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxloc._jit import filter_jit
from jaxloc._linalg import matmul
from jaxloc.beliefs import Gaussian, gate
from jaxloc.beliefs.square_root import cholesky, whiten
from jaxloc.images.patches import extract
from jaxloc.multiview.stereo_triangulation import triangulate
from jaxloc.odometry.stereo_matching import StereoFeatures
from jaxloc.poses import SE3
from jaxloc.refinement import StereoMatches
from jaxloc.sensors import StereoRig
from jaxloc.solvers import RobustEstimate

_STILL_CORRELATION = 0.5  # of a patch with one that stands where it would
_AS_ALIKE = 0.1  # insignificant difference of correlations


class FlowOptions(eqx.Module):
    """Options of the test for moving points.

    Attributes:
        capacity: largest number of unexplained points of a frame.
        patch: rows and columns of the patches that are compared, px.
        reach: columns and rows by which a point may move beside what the camera's motion makes it move, px.
        correlation: least correlation of two patches of one point.
        beside: a point is explained by a match this near, px.
        sigma: standard deviation of a keypoint that is not refined, px.
        farthest: largest depth of points with a usable velocity, m.
        slowest: speed below which a point is taken to stand, m/s.
        fastest: largest plausible speed, m/s.
        probability: of a standing point to pass for one; whole objects are tested more strictly later.
    """

    capacity: int = eqx.field(static=True, default=512)
    patch: tuple[int, int] = eqx.field(static=True, default=(9, 13))
    reach: tuple[float, float] = eqx.field(static=True, default=(150.0, 12.0))
    correlation: float = eqx.field(static=True, default=0.7)
    beside: float = eqx.field(static=True, default=2.0)
    sigma: float = eqx.field(static=True, default=0.5)
    farthest: float = eqx.field(static=True, default=70.0)
    slowest: float = eqx.field(static=True, default=1.5)
    fastest: float = eqx.field(static=True, default=60.0)
    probability: float = eqx.field(static=True, default=0.9)


class MovingPoints(eqx.Module):
    """Points that move relative to the world, in coordinates of the current left camera.

    Attributes:
        positions: "n 3", m, camera frame.
        velocities: "n 3" against the ground, in the axes of the camera, m/s.
        position_covariances: of the positions.
        velocity_covariances: of the velocities, the error of the camera's motion included.
        uv: "n 2" pixels in the left image.
        valid: which slots hold a point.
    """

    positions: Float[Array, "n 3"]
    velocities: Float[Array, "n 3"]
    position_covariances: Float[Array, "n 3 3"]
    velocity_covariances: Float[Array, "n 3 3"]
    uv: Float[Array, "n 2"]
    valid: Bool[Array, " n"]


class _Points(eqx.Module):
    """Some features of a frame."""

    measured: Float[Array, "n 3"]
    position: Gaussian
    patches: Float[Array, "n p"]
    valid: Bool[Array, " n"]


@filter_jit
def find_moving(
    rig: StereoRig,
    previous: StereoFeatures,
    current: StereoFeatures,
    matches: StereoMatches,
    motion: RobustEstimate,
    dt: Float[Array, ""],
    *,
    options: FlowOptions = FlowOptions(),
) -> MovingPoints:
    """Finds matched points that the camera motion does not explain.

    A point moves if its displacement is larger than its covariance allows: that of both triangulations and of the
    camera's motion. A point that has a partner where it would be if it stood still is taken to stand.

    Args:
        rig: the stereo rig.
        previous: features of the frame before.
        current: features of this frame.
        matches: between both, as the odometry used them.
        motion: of the camera, from these matches.
        dt: time between the frames, s.
        options: what counts as moving.

    Returns:
        The points, as many slots as the options have capacity.

    References:
        Thesis 1.2 (static and dynamic points) [T-4], 5.4 (compensation of the own motion) [T-78], [T-79].
    """
    pose = motion.estimate.gaussian()
    before = _unexplained(rig, previous, matches.previous, motion.inliers, options)
    after = _unexplained(rig, current, matches.current, motion.inliers, options)
    expected, expected_covariance = _carry(before, pose)
    alike = matmul(before.patches, after.patches.T)
    both = before.valid[:, None] & after.valid[None, :]
    near = _within(rig, expected, before, after, dt, options) & both
    still = _still(rig, expected, expected_covariance, after, options) & both & (alike > _STILL_CORRELATION)
    # On a textured object some patch always lies where it would stand: it counts if none elsewhere is more alike.
    best = jnp.where(near | still, alike, -1.0)
    still = still & (alike > jnp.max(best, axis=1, keepdims=True) - _AS_ALIKE)
    still = still & (alike > jnp.max(best, axis=0, keepdims=True) - _AS_ALIKE)
    near = near & ~jnp.any(still, axis=1)[:, None] & ~jnp.any(still, axis=0)[None, :]
    score = jnp.where(near & (alike > options.correlation), alike, -1.0)
    partner, back = jnp.argmax(score, axis=1), jnp.argmax(score, axis=0)
    mutual = back[partner] == jnp.arange(score.shape[0])
    found = mutual & (jnp.max(score, axis=1) > 0.0)
    seen = jax.tree.map(lambda leaf: leaf[partner], after)
    flow = seen.position.mean - expected
    covariance = seen.position.covariance + expected_covariance
    squared = jax.vmap(lambda f, c: jnp.sum(whiten(cholesky(c), f) ** 2))(flow, covariance)
    moves = ~gate(squared, 3, options.probability) & (jnp.sum(flow**2, axis=1) > (options.slowest * dt) ** 2)
    return MovingPoints(
        seen.position.mean,
        flow / dt,
        seen.position.covariance,
        covariance / dt**2,
        seen.measured[:, jnp.array([0, 2])],
        found & moves,
    )


def _unexplained(
    rig: StereoRig, features: StereoFeatures, matched: Float[Array, "m 3"], inliers: Bool[Array, " m"], options
) -> _Points:
    """Features with depth that no match of the camera's motion is near to, with their patches."""
    if not features.has_depth.shape[0]:
        # One empty slot in place of none.
        parts = (features.measured, features.variance, features.has_depth)
        slots = tuple(jnp.zeros((1, *part.shape[1:]), part.dtype) for part in parts)
        features = eqx.tree_at(lambda f: (f.measured, f.variance, f.has_depth), features, slots)
    apart = features.measured[:, None, :] - matched[None, :, :]
    beside = jnp.max(jnp.abs(apart), axis=-1) < options.beside
    explained = jnp.any(beside & inliers[None, :], axis=1)
    safe = jnp.where(features.has_depth[:, None], features.measured, jnp.array([1.0, 0.0, 0.0])[None, :])
    depth = rig.triangulate(safe)[:, 2]
    wanted = features.has_depth & ~explained & (depth > 0.0) & (depth < options.farthest)
    count = min(options.capacity, wanted.shape[0])
    order = lax.top_k(wanted.astype(jnp.float32), count)[1]
    measured, variance, valid = safe[order], features.variance[order], wanted[order]
    uv = measured[:, jnp.array([0, 2])]
    patches = extract(features.left, uv, size=options.patch)
    values = patches.values.reshape(count, math.prod(patches.values.shape[1:]))
    values = values - jnp.mean(values, axis=1, keepdims=True)
    norm = jnp.sqrt(jnp.sum(values**2, axis=1, keepdims=True))
    values = values / jnp.maximum(norm, 1e-3)
    valid = valid & patches.inside & (norm[:, 0] > 1.0)
    position = jax.vmap(lambda z, v: triangulate(rig, z, _noise(v, options.sigma)))(measured, variance)
    return _Points(measured, position, values, valid)


def _noise(variance: Float[Array, ""], sigma: float) -> Float[Array, "3 3"]:
    """Of (u_left, u_right, v): the point lies where its keypoint does, give or take; the disparity is refined."""
    own = jnp.asarray(sigma**2, variance.dtype)
    zero = jnp.zeros_like(own)
    rows = ((own, own, zero), (own, own + variance, zero), (zero, zero, own))
    return jnp.stack([jnp.stack(row) for row in rows])


def _carry(points: _Points, pose: Gaussian) -> tuple[Float[Array, "n 3"], Float[Array, "n 3 3"]]:
    """Where standing points of the previous frame are in the current one, and how surely."""
    back: SE3 = pose.mean.inverse()
    places = back.apply(points.position.mean)
    rotation = back.rotation.matrix()
    turned = matmul(matmul(rotation, points.position.covariance), rotation.T)

    # T^-1 exp(-d) p: the place moves by -d_t - d_r x p = -d_t + p x d_r.
    def slip(place):
        x, y, z = place
        zero = jnp.zeros_like(x)
        cross = jnp.stack([jnp.stack(row) for row in ((zero, -z, y), (z, zero, -x), (-y, x, zero))])
        jacobian = jnp.concatenate([-jnp.eye(3, dtype=place.dtype), cross], axis=1)
        return matmul(matmul(jacobian, pose.covariance), jacobian.T)

    return places, turned + jax.vmap(slip)(places)


def _still(
    rig: StereoRig, expected: Float[Array, "n 3"], covariance: Float[Array, "n 3 3"], after: _Points, options
) -> Bool[Array, "n m"]:
    """Which current points lie where a standing one would: within three sigmas and two pixels."""
    in_front = expected[:, 2] > 1.0
    safe = jnp.where(in_front[:, None], expected, jnp.array([0.0, 0.0, 10.0])[None, :])
    places = rig.project(safe)
    jacobian = jax.vmap(jax.jacfwd(lambda p: rig.project(p[None])[0]))(safe)
    variance = jnp.diagonal(matmul(matmul(jacobian, covariance), jacobian.mT), axis1=-2, axis2=-1)
    room = 3.0 * jnp.sqrt(variance) + 2.0
    apart = jnp.abs(places[:, None, :] - after.measured[None, :, :])
    return jnp.all(apart < room[:, None, :], axis=-1) & in_front[:, None]


def _within(
    rig: StereoRig, expected: Float[Array, "n 3"], before: _Points, after: _Points, dt: Float[Array, ""], options
) -> Bool[Array, "n m"]:
    """Which pairs can be one moving point: near in the image, and in space no farther than anything drives."""
    in_front = expected[:, 2] > 1.0
    places = rig.project(jnp.where(in_front[:, None], expected, jnp.array([0.0, 0.0, 10.0])[None, :]))
    columns = jnp.abs(places[:, 0][:, None] - after.measured[None, :, 0])
    rows = jnp.abs(places[:, 2][:, None] - after.measured[None, :, 2])
    deep = (
        jnp.sqrt(before.position.covariance[:, 2, 2])[:, None] + jnp.sqrt(after.position.covariance[:, 2, 2])[None, :]
    )
    apart = jnp.abs(expected[:, None, :] - after.position.mean[None, :, :])
    limit = options.fastest * dt
    reachable = (apart[..., 0] < limit) & (apart[..., 1] < 0.1 * limit + 0.5) & (apart[..., 2] < limit + 3.0 * deep)
    return reachable & (columns < options.reach[0]) & (rows < options.reach[1]) & in_front[:, None]
