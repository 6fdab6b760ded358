"""Distances along paths, and trajectories matched by time stamp."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxloc.poses import Trajectory


def safe_sqrt(square: Float[Array, "*s"]) -> Float[Array, "*s"]:
    """A square root whose derivative at zero is zero."""
    positive = square > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1.0)), 0.0)


def step_lengths(positions: Float[Array, "n 3"]) -> Float[Array, " m"]:
    """Distances between successive positions, m."""
    return safe_sqrt(jnp.sum(jnp.diff(positions, axis=0) ** 2, axis=1))


def path_distances(positions: Float[Array, "n 3"]) -> Float[Array, " n"]:
    """Length of the path up to each position.

    Args:
        positions: m.

    Returns:
        Distances, m; the first is zero.
    """
    if not positions.shape[0]:
        return jnp.zeros(0, positions.dtype)
    return jnp.concatenate([jnp.zeros(1, positions.dtype), jnp.cumsum(step_lengths(positions))])


def rotation_angle(matrix: Float[Array, "3 3"]) -> Float[Array, ""]:
    """Angle of a rotation, accurate near zero also in single precision (the arc cosine of the trace is not).

    Args:
        matrix: rotation matrix; rounding of its entries hardly matters.

    Returns:
        Angle in [0, pi], rad.
    """
    skew = jnp.stack([matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]])
    sine, cosine = 0.5 * safe_sqrt(jnp.sum(skew**2)), 0.5 * (jnp.trace(matrix) - 1.0)
    nonzero = (sine > 0) | (cosine != 0)
    return jnp.arctan2(sine, jnp.where(nonzero, cosine, 1.0))


def check_lengths(estimate: Trajectory, truth: Trajectory) -> None:
    """Checks that two paths have equally many poses.

    Args:
        estimate: one path.
        truth: the other.

    Raises:
        ValueError: when they do not.
    """
    if len(estimate) != len(truth):
        raise ValueError(
            f"The estimate has {len(estimate)} poses and the truth {len(truth)}: compare equally many, for example "
            "those that evaluation.trajectories.synchronize pairs by their times."
        )


def synchronize(
    estimate: Trajectory, truth: Trajectory, *, max_difference: float = 0.01
) -> tuple[Trajectory, Trajectory]:
    """Pairs the poses of two paths whose times are nearest, and leaves out those that have no partner.

    The number of pairs depends on the times, so this runs on the host and cannot be traced.

    Args:
        estimate: one path.
        truth: the other; their times count from the same stamp.
        max_difference: largest difference of the times of a pair, s.

    Returns:
        Both paths, with equally many poses.

    Raises:
        ValueError: when no poses pair up.
    """
    times, others = np.asarray(estimate.times), np.asarray(truth.times)
    swap = len(times) > len(others)
    short, long = (others, times) if swap else (times, others)
    after = np.clip(np.searchsorted(long, short), 1, max(len(long) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(long) - 1)
    nearest = np.where(np.abs(long[before] - short) <= np.abs(long[after] - short), before, after)
    keep = np.flatnonzero(np.abs(long[nearest] - short) <= max_difference)
    if not len(keep):
        raise ValueError(f"No poses lie within {max_difference} s of each other; do times count from the same stamp?")
    chosen = (nearest[keep], keep) if swap else (keep, nearest[keep])
    return tuple(
        Trajectory(path.times[index], path[index]) for path, index in zip((estimate, truth), chosen, strict=True)
    )
