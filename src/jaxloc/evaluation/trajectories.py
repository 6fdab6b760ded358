"""How far an estimated path is from the true one: absolute (ATE) and relative pose errors (RPE).

The two paths must have the same number of poses; :func:`synchronize` makes them so by their stamps.

References:
    Sturm, Engelhard, Endres, Burgard and Cremers, "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012.
"""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxloc.evaluation.alignments import Alignment, RigidAlignment
from jaxloc.poses import Trajectory


class Errors(eqx.Module):
    """Error values, some of which may not count.

    Args:
        values: one a pose or pair of poses; zero where not valid.
        valid: which count.
    """

    values: Float[Array, " n"]
    valid: Bool[Array, " n"]

    def count(self) -> Int[Array, ""]:
        """How many values count."""
        return jnp.sum(self.valid)

    def mean(self) -> Float[Array, ""]:
        """Their mean; zero where none counts."""
        return jnp.sum(self.values) / jnp.maximum(self.count(), 1).astype(self.values.dtype)

    def rmse(self) -> Float[Array, ""]:
        """The root of their mean square; zero where none counts."""
        return _safe_sqrt(jnp.sum(self.values**2) / jnp.maximum(self.count(), 1).astype(self.values.dtype))

    def largest(self) -> Float[Array, ""]:
        """The largest; zero where none counts."""
        return jnp.max(jnp.where(self.valid, self.values, 0.0), initial=0.0)

    def median(self) -> Float[Array, ""]:
        """Their median; zero where none counts."""
        ordered = jnp.sort(jnp.where(self.valid, self.values, jnp.inf))
        count = jnp.maximum(self.count(), 1)
        middle = 0.5 * (ordered[(count - 1) // 2] + ordered[count // 2])
        return jnp.where(self.count() > 0, middle, 0.0)


class RelativeErrors(eqx.Module):
    """Errors of motions between pairs of poses.

    Args:
        translation: m.
        rotation: rad.
    """

    translation: Errors
    rotation: Errors


class Pairs(eqx.Module):
    """Pairs of poses.

    Args:
        first: index of the earlier one.
        second: index of the later one.
        valid: which pairs count.
    """

    first: Int[Array, " k"]
    second: Int[Array, " k"]
    valid: Bool[Array, " k"]


class Spacing(eqx.Module):
    """Which pairs of poses are compared."""

    @abstractmethod
    def pairs(self, positions: Float[Array, "n 3"]) -> Pairs:
        """Finds the pairs of a path of positions in m."""


class Frames(Spacing):
    """Pairs of poses a number of frames apart.

    Args:
        delta: number of frames.
        all_pairs: from every frame; otherwise pairs follow each other without overlap.
    """

    delta: int = eqx.field(static=True, default=1)
    all_pairs: bool = eqx.field(static=True, default=True)

    def pairs(self, positions: Float[Array, "n 3"]) -> Pairs:
        """Finds the pairs of a path of positions in m."""
        last = positions.shape[0] - self.delta
        first = jnp.arange(0, max(last, 0), 1 if self.all_pairs else self.delta)
        return Pairs(first, first + self.delta, jnp.ones(first.shape, bool))


class Meters(Spacing):
    """Pairs of poses between which a length of the path lies, as it is measured on the true path.

    Args:
        delta: length of the path, m.
        all_pairs: from every frame to the one whose distance is nearest to ``delta``; otherwise pairs follow each other
            without overlap, each ending at the first frame that is far enough.
        tolerance: with ``all_pairs``, the largest deviation from ``delta``, as a fraction of it.
    """

    delta: float
    all_pairs: bool = eqx.field(static=True, default=False)
    tolerance: float = 0.1

    def pairs(self, positions: Float[Array, "n 3"]) -> Pairs:
        """Finds the pairs of a path of positions in m."""
        return self._overlapping(positions) if self.all_pairs else self._consecutive(positions)

    def _consecutive(self, positions):
        def step(state, edge):
            start, path = state
            index, length = edge
            path = path + length
            ends = path >= self.delta
            following = (jnp.where(ends, index, start), jnp.where(ends, 0.0, path))
            return following, (start, ends)

        indices = jnp.arange(1, positions.shape[0])
        begin = (jnp.zeros((), indices.dtype), jnp.zeros((), positions.dtype))
        _, (starts, ends) = jax.lax.scan(step, begin, (indices, _step_lengths(positions)))
        return Pairs(starts, indices, ends)

    def _overlapping(self, positions):
        distances = path_distances(positions)
        first = jnp.arange(positions.shape[0] - 1, dtype=jnp.int32)
        wanted = distances[:-1] + self.delta
        above = jnp.clip(jnp.searchsorted(distances, wanted), first + 1, positions.shape[0] - 1)
        below = jnp.maximum(jnp.searchsorted(distances, distances[above - 1]), first + 1)
        gap_above, gap_below = jnp.abs(distances[above] - wanted), jnp.abs(distances[below] - wanted)
        second = jnp.where(gap_below <= gap_above, below, above)
        return Pairs(first, second, jnp.minimum(gap_above, gap_below) <= self.tolerance * self.delta)


def _safe_sqrt(square: Float[Array, "*s"]) -> Float[Array, "*s"]:
    """A square root whose derivative at zero is zero."""
    positive = square > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1.0)), 0.0)


def _step_lengths(positions: Float[Array, "n 3"]) -> Float[Array, " m"]:
    return _safe_sqrt(jnp.sum(jnp.diff(positions, axis=0) ** 2, axis=1))


def path_distances(positions: Float[Array, "n 3"]) -> Float[Array, " n"]:
    """Length of the path up to each position.

    Args:
        positions: m.

    Returns:
        Distances, m; the first is zero.
    """
    return jnp.concatenate([jnp.zeros(1, positions.dtype), jnp.cumsum(_step_lengths(positions))])


def rotation_angle(matrix: Float[Array, "3 3"]) -> Float[Array, ""]:
    """Angle of a rotation, accurate near zero also in single precision (the arc cosine of the trace is not).

    Args:
        matrix: rotation matrix; rounding of its entries hardly matters.

    Returns:
        Angle in [0, pi], rad.
    """
    skew = jnp.stack([matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]])
    sine, cosine = 0.5 * _safe_sqrt(jnp.sum(skew**2)), 0.5 * (jnp.trace(matrix) - 1.0)
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


@eqx.filter_jit
def ate(
    estimate: Trajectory,
    truth: Trajectory,
    *,
    alignment: Alignment = RigidAlignment(),  # noqa: B008 (a record without fields)
    valid: Bool[Array, " n"] | None = None,
) -> Errors:
    """Absolute trajectory error: the distance between the positions at the same time, after alignment.

    Args:
        estimate: the estimated path.
        truth: the true path, pose by pose.
        alignment: how the estimate is moved first. The gradient of the RMSE through it is exact.
        valid: which poses count; all where not given.

    Returns:
        A distance for each pose, m.

    Raises:
        ValueError: when the paths have different numbers of poses.

    References:
        Sturm et al., IROS 2012, section IV.

    Example:
        >>> import jaxloc as jl
        >>> path = jl.data.simulate.points.simulate_drive(20, key=jax.random.key(0))
        >>> bool(ate(path, path).rmse() < 1e-4)
        True
    """
    check_lengths(estimate, truth)
    valid = jnp.ones(len(truth), bool) if valid is None else valid
    points = jnp.where(valid[:, None], estimate.positions, 0.0)
    targets = jnp.where(valid[:, None], truth.positions, 0.0)
    gaps = alignment.align(points, targets, valid) - targets
    return Errors(jnp.where(valid, _safe_sqrt(jnp.sum(gaps**2, axis=1)), 0.0), valid)


@eqx.filter_jit
def rpe(
    estimate: Trajectory,
    truth: Trajectory,
    *,
    spacing: Spacing = Frames(1),  # noqa: B008 (a record of constants)
) -> RelativeErrors:
    """Relative pose error: the difference between the estimated and the true motion between pairs of poses.

    Args:
        estimate: the estimated path.
        truth: the true path, pose by pose.
        spacing: which pairs; ``Frames(1)`` compares the motions between successive frames.

    Returns:
        Errors for each pair, in m and rad.

    Raises:
        ValueError: when the paths have different numbers of poses.

    References:
        Sturm et al., IROS 2012, section IV.

    Example:
        >>> import jaxloc as jl
        >>> path = jl.data.simulate.points.simulate_drive(20, key=jax.random.key(0))
        >>> bool(rpe(path, path).translation.largest() < 1e-4)
        True
    """
    check_lengths(estimate, truth)
    pairs = spacing.pairs(truth.positions)
    differences = motion_differences(estimate, truth, pairs.first, pairs.second)
    translation = _safe_sqrt(jnp.sum(differences.translation**2, axis=1))
    rotation = jax.vmap(rotation_angle)(differences.rotation.rotation_matrix)
    errors = (Errors(jnp.where(pairs.valid, values, 0.0), pairs.valid) for values in (translation, rotation))
    return RelativeErrors(*errors)


def motion_differences(
    estimate: Trajectory, truth: Trajectory, first: Int[Array, " k"], second: Int[Array, " k"]
) -> Any:
    """Estimated motions as seen from the true ones: ``(Q_i^-1 Q_j)^-1 (P_i^-1 P_j)``.

    Args:
        estimate: the estimated path P.
        truth: the true path Q.
        first: indices i.
        second: indices j.

    Returns:
        Stacked poses; the identity where the motions agree.
    """

    def difference(q_i, q_j, p_i, p_j):
        return (q_i.inverse() @ q_j).inverse() @ (p_i.inverse() @ p_j)

    return jax.vmap(difference)(truth[first], truth[second], estimate[first], estimate[second])


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
