"""Clustering of moving points into objects, with position, velocity and covariance."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxloc._jit import filter_jit
from jaxloc.beliefs import gate
from jaxloc.beliefs.square_root import cholesky, whiten
from jaxloc.odometry.scene_flow import MovingPoints


class GroupOptions(eqx.Module):
    """Options of the clustering.

    Attributes:
        capacity: objects of a frame, at most.
        most_points: moving points that are looked at, at most.
        fewest_points: an object has at least so many.
        near: points of one object are at most so far apart along (right, down, forward), m; their depth may differ by
            three sigmas more, but at most by three times as much.
        slack: velocities within one object differ by so much beside their noise, m/s.
        probability: that velocities of one object pass for alike.
        still: probability of a standing object to pass for one.
    """

    capacity: int = eqx.field(static=True, default=32)
    most_points: int = eqx.field(static=True, default=128)
    fewest_points: int = eqx.field(static=True, default=3)
    near: tuple[float, float, float] = eqx.field(static=True, default=(2.5, 1.5, 2.5))
    slack: float = eqx.field(static=True, default=1.5)
    probability: float = eqx.field(static=True, default=0.99)
    still: float = eqx.field(static=True, default=0.9999)


class MovingObjects(eqx.Module):
    """Moving objects of one frame, in camera coordinates.

    Attributes:
        positions: "k 3" weighted mean of the points, m.
        velocities: "k 3" against the ground, m/s.
        position_covariances: of the mean of the points; where on the object they lie is not in it.
        velocity_covariances: of the velocities.
        boxes: "k 4" (left, top, right, bottom) of the points in the left image, px.
        counts: how many points.
        valid: which slots hold an object.
    """

    positions: Float[Array, "k 3"]
    velocities: Float[Array, "k 3"]
    position_covariances: Float[Array, "k 3 3"]
    velocity_covariances: Float[Array, "k 3 3"]
    boxes: Float[Array, "k 4"]
    counts: Int[Array, " k"]
    valid: Bool[Array, " k"]


@filter_jit
def group_points(points: MovingPoints, *, options: GroupOptions = GroupOptions()) -> MovingObjects:
    """Clusters moving points: connected components of points that are close in position and velocity.

    Args:
        points: those of one frame that move.
        options: what counts as one object.

    Returns:
        The largest sets, as many slots as the options have capacity.

    References:
        Lenz, Ziegler, Geiger and Roser, "Sparse scene flow segmentation for moving object detection in urban
        environments", IV 2011; rigid bodies as points with a velocity [T-12], [B.7].
    """
    if not points.valid.shape[0]:
        # One empty slot in place of none.
        points = jax.tree.map(lambda leaf: jnp.zeros((1, *leaf.shape[1:]), leaf.dtype), points)
    count = min(options.most_points, points.valid.shape[0])
    order = lax.top_k(points.valid.astype(jnp.float32), count)[1]
    points = jax.tree.map(lambda leaf: leaf[order], points)
    labels = _connect(_alike(points, options), points.valid)
    member = (labels[None, :] == jnp.arange(count)[:, None]) & points.valid[None, :]
    sizes, roots = lax.top_k(jnp.sum(member, axis=1), min(options.capacity, count))
    member = member[roots].astype(points.positions.dtype)
    positions, position_covariances = _mean(member, points.positions, points.position_covariances)
    velocities, velocity_covariances = _mean(member, points.velocities, points.velocity_covariances)
    boxes = jax.vmap(lambda row: _box(points.uv, row > 0.0))(member)
    squared = jax.vmap(lambda v, c: jnp.sum(whiten(cholesky(c), v) ** 2))(velocities, velocity_covariances)
    valid = (sizes >= options.fewest_points) & ~gate(squared, 3, options.still)
    return MovingObjects(positions, velocities, position_covariances, velocity_covariances, boxes, sizes, valid)


def _alike(points: MovingPoints, options: GroupOptions) -> Bool[Array, "n n"]:
    # Depth is the uncertain part, and moves a point along its ray: distances beside the ray are those of the image.
    depth = jnp.maximum(points.positions[:, 2], 0.1)
    rays = points.positions[:, :2] / depth[:, None]
    nearer = jnp.minimum(depth[:, None], depth[None, :])
    beside = jnp.abs(rays[:, None, :] - rays[None, :, :]) * nearer[..., None]
    deep = points.position_covariances[:, 2, 2]
    room = options.near[2] + jnp.minimum(3.0 * jnp.sqrt(deep[:, None] + deep[None, :]), 2.0 * options.near[2])
    together = (beside[..., 0] < options.near[0]) & (beside[..., 1] < options.near[1])
    together = together & (jnp.abs(depth[:, None] - depth[None, :]) < room)
    eye = options.slack**2 * jnp.eye(3, dtype=depth.dtype)

    def distance(i):
        difference = points.velocities - points.velocities[i][None, :]
        covariance = points.velocity_covariances + (points.velocity_covariances[i] + eye)[None]
        return jax.vmap(lambda d, c: jnp.sum(whiten(cholesky(c), d) ** 2))(difference, covariance)

    squared = jax.vmap(distance)(jnp.arange(depth.shape[0]))
    both = points.valid[:, None] & points.valid[None, :]
    return both & together & gate(squared, 3, options.probability)


def _connect(alike: Bool[Array, "n n"], valid: Bool[Array, " n"]) -> Int[Array, " n"]:
    """The smallest index that each point is connected with."""
    own = jnp.where(valid, jnp.arange(valid.shape[0]), valid.shape[0])

    def propagate(state):
        labels, _ = state
        new = jnp.minimum(labels, jnp.min(jnp.where(alike, labels[None, :], labels.shape[0]), axis=1))
        return new, jnp.any(new != labels)

    return lax.while_loop(lambda state: state[1], propagate, (own, jnp.array(True)))[0]


def _mean(
    member: Float[Array, "k n"], values: Float[Array, "n 3"], covariances: Float[Array, "n 3 3"]
) -> tuple[Float[Array, "k 3"], Float[Array, "k 3 3"]]:
    """Means weighted by how well each depth is known, and their covariances."""
    spread = jnp.trace(covariances, axis1=1, axis2=2)
    # Empty slots may hold zeros.
    weights = member / jnp.where(spread > 0.0, spread, 1.0)[None, :]
    total = jnp.sum(weights, axis=1, keepdims=True)
    weights = weights / jnp.where(total > 0.0, total, 1.0)
    covariance = jnp.einsum("kn,nij->kij", weights**2, covariances, precision="highest")
    empty = (total[:, 0] <= 0.0)[:, None, None]
    return jnp.einsum("kn,ni->ki", weights, values, precision="highest"), jnp.where(
        empty, jnp.eye(3, dtype=values.dtype)[None], covariance
    )


def _box(uv: Float[Array, "n 2"], member: Bool[Array, " n"]) -> Float[Array, "4"]:
    some = jnp.any(member)
    low = jnp.min(jnp.where(member[:, None], uv, jnp.inf), axis=0)
    high = jnp.max(jnp.where(member[:, None], uv, -jnp.inf), axis=0)
    return jnp.where(some, jnp.concatenate([low, high]), 0.0)
