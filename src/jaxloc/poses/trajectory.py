"""Trajectories: poses with time stamps, their interpolation, and dead reckoning."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxloc import _tree as tree
from jaxloc._arguments import checked
from jaxloc.poses.lie_group import Group, bounded, largest_length, unless
from jaxloc.poses.se3 import SE3


class Trajectory(eqx.Module):
    """A trajectory: stacked poses ``T_world_body`` with increasing times.

    Give times relative to the start of the recording: float32 rounds seconds since 1970 to two minutes.

    Attributes:
        times: seconds.
        poses: poses stacked along the leading axis of each array (`SE2` or `SE3`).

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> straight = jnp.eye(4)[None].repeat(3, axis=0).at[:, 0, 3].set(jnp.array([0.0, 1.0, 2.0]))
        >>> path = jl.poses.Trajectory.from_matrices(jnp.arange(3.0), straight)
        >>> float(path.length())
        2.0
        >>> path.at(jnp.array(0.5)).translation.tolist()
        [0.5, 0.0, 0.0]
    """

    times: Float[Array, " n"]
    poses: Group

    def __check_init__(self):
        if self.poses.batch_shape != self.times.shape:
            raise ValueError(
                f"{self.times.shape[0]} times came with poses of stack shape {self.poses.batch_shape}; "
                "each time needs one pose."
            )

    @staticmethod
    @checked
    def from_matrices(times: Float[Array, " n"], matrices: Float[Array, "n 4 4"]) -> "Trajectory":
        """Trajectory in space of homogeneous matrices."""
        return Trajectory(times, jax.vmap(SE3.from_matrix)(matrices))

    def __len__(self) -> int:
        return self.times.shape[0]

    def __getitem__(self, index: Any) -> Any:
        """The pose (for an integer) or stack of poses (for a slice) at an index."""
        return jax.tree.map(lambda leaf: leaf[index], self.poses)

    @property
    def positions(self) -> Float[Array, "n k"]:
        """Positions in the world frame, m."""
        return self.poses.translation

    def matrices(self) -> Float[Array, "n k k"]:
        """Homogeneous matrices."""
        return jax.vmap(lambda pose: pose.matrix())(self.poses)

    def relative(self) -> Any:
        """The motions ``T_k_(k+1)`` between successive poses, stacked."""
        return jax.vmap(lambda a, b: a.inverse() @ b)(self[:-1], self[1:])

    def length(self) -> Float[Array, ""]:
        """Length of the path, m."""
        return jnp.sum(jnp.linalg.norm(jnp.diff(self.positions, axis=0), axis=1))

    @checked
    def at(self, time: Float[Array, ""]) -> Any:
        """The pose at a time, along the geodesic between its neighbors; clamped to the ends."""
        after = jnp.clip(jnp.searchsorted(self.times, time), 1, len(self) - 1)
        first, last = self.times[after - 1], self.times[after]
        span = jnp.where(last > first, last - first, 1.0)
        fraction = jnp.clip((time - first) / span, 0.0, 1.0)
        return interpolate(self[after - 1], self[after], fraction)


def chain(initial: Any, motions: Any) -> Any:
    """Dead reckoning: poses reached by successive motions.

    Args:
        initial: pose ``T_world_0``.
        motions: stacked ``T_k_(k+1)``, n of them.

    Returns:
        The n + 1 stacked poses ``T_world_k``, the initial one included [K-4].
    """

    def step(pose: Any, motion: Any) -> Any:
        following = pose @ motion
        return following, following

    _, rest = jax.lax.scan(step, initial, motions)
    return jax.tree.map(lambda first, others: jnp.concatenate([first[None], others]), initial, rest)


@checked
def interpolate(a: Any, b: Any, fraction: Float[Array, ""]) -> Any:
    """Geodesic interpolation between two poses, at a fraction from 0 to 1; NaN where one of them is not finite."""
    leaves, structure = jax.tree.flatten((a, b, fraction))
    # Their difference is finite too.
    finite, leaves = bounded(*((leaf, largest_length(leaf.dtype)) for leaf in leaves))
    first, second, part = jax.tree.unflatten(structure, leaves)
    safe = tree.where(finite, (first, second), (a.identity(leaves[0].dtype),) * 2)
    return unless(finite, safe[0].retract(part * safe[0].local(safe[1])))
