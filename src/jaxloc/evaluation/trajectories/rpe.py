"""Relative pose error (RPE)."""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxloc._jit import filter_jit
from jaxloc.evaluation.trajectories.ate import Errors
from jaxloc.evaluation.trajectories.paths import check_lengths, path_distances, rotation_angle, safe_sqrt, step_lengths
from jaxloc.poses import Trajectory


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
        _, (starts, ends) = jax.lax.scan(step, begin, (indices, step_lengths(positions)))
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


@filter_jit
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
        >>> path = jl.data.simulate.stereo_points.simulate_drive(20, key=jax.random.key(0))
        >>> bool(rpe(path, path).translation.largest() < 1e-4)
        True
    """
    check_lengths(estimate, truth)
    pairs = spacing.pairs(truth.positions)
    differences = motion_differences(estimate, truth, pairs.first, pairs.second)
    translation = safe_sqrt(jnp.sum(differences.translation**2, axis=1))
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
