"""Absolute trajectory error (ATE)."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxloc._jit import filter_jit
from jaxloc.evaluation.trajectories.alignment import Alignment, RigidAlignment
from jaxloc.evaluation.trajectories.paths import check_lengths, safe_sqrt
from jaxloc.poses import Trajectory


class Errors(eqx.Module):
    """Error values with a validity mask.

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
        return safe_sqrt(jnp.sum(self.values**2) / jnp.maximum(self.count(), 1).astype(self.values.dtype))

    def largest(self) -> Float[Array, ""]:
        """The largest; zero where none counts."""
        return jnp.max(jnp.where(self.valid, self.values, 0.0), initial=0.0)

    def median(self) -> Float[Array, ""]:
        """Their median; zero where none counts."""
        ordered = jnp.sort(jnp.where(self.valid, self.values, jnp.inf))
        count = jnp.maximum(self.count(), 1)
        middle = 0.5 * (ordered[(count - 1) // 2] + ordered[count // 2])
        return jnp.where(self.count() > 0, middle, 0.0)


@filter_jit
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
        >>> import jax, jaxloc as jl
        >>> path = jl.data.simulate.stereo_points.simulate_drive(20, key=jax.random.key(0))
        >>> bool(ate(path, path).rmse() < 1e-4)
        True
    """
    check_lengths(estimate, truth)
    valid = jnp.ones(len(truth), bool) if valid is None else valid
    points = jnp.where(valid[:, None], estimate.positions, 0.0)
    targets = jnp.where(valid[:, None], truth.positions, 0.0)
    gaps = alignment.align(points, targets, valid) - targets
    return Errors(jnp.where(valid, safe_sqrt(jnp.sum(gaps**2, axis=1)), 0.0), valid)
