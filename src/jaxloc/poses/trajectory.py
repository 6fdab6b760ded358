"""Poses with time stamps."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxloc.poses.lie_group import Group
from jaxloc.poses.se3 import SE3


class Trajectory(eqx.Module):
    """Where a moving frame was, and when: a stack of poses ``T_world_body`` with increasing times.

    Times count from the start of the recording: in float32, seconds since 1970 would be rounded to two minutes.

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
        """The motions ``T_k_(k+1)`` between neighbours, stacked."""
        return jax.vmap(lambda a, b: a.inverse() @ b)(self[:-1], self[1:])

    def length(self) -> Float[Array, ""]:
        """Length of the path, m."""
        return jnp.sum(jnp.linalg.norm(jnp.diff(self.positions, axis=0), axis=1))

    def at(self, time: Float[Array, ""]) -> Any:
        """The pose at a time, along the geodesic between its neighbours; clamped to the ends."""
        after = jnp.clip(jnp.searchsorted(self.times, time), 1, len(self) - 1)
        start, end = self.times[after - 1], self.times[after]
        span = jnp.where(end > start, end - start, 1.0)
        fraction = jnp.clip((time - start) / span, 0.0, 1.0)
        return interpolate(self[after - 1], self[after], fraction)


def chain(start: Any, motions: Any) -> Any:
    """Poses reached by motions one after the other: dead reckoning.

    Args:
        start: pose ``T_world_0``.
        motions: stacked ``T_k_(k+1)``, n of them.

    Returns:
        The n + 1 stacked poses ``T_world_k``, the start among them [K-4].
    """

    def step(pose: Any, motion: Any) -> Any:
        following = pose @ motion
        return following, following

    _, rest = jax.lax.scan(step, start, motions)
    return jax.tree.map(lambda first, others: jnp.concatenate([first[None], others]), start, rest)


def interpolate(a: Any, b: Any, fraction: Float[Array, ""]) -> Any:
    """The pose a fraction of the way along the geodesic from one pose to another."""
    return a.retract(fraction * a.local(b))
