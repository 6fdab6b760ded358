"""KITTI odometry metric: drift of translation and rotation over path segments."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxloc._jit import filter_jit
from jaxloc.evaluation.trajectories.paths import check_lengths, path_distances, rotation_angle
from jaxloc.evaluation.trajectories.rpe import motion_differences
from jaxloc.poses import Trajectory

KITTI_LENGTHS = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)


class SegmentErrors(eqx.Module):
    """Errors over path segments of several lengths and first frames.

    Args:
        translation: m a meter.
        rotation: rad a meter.
        valid: which stretches fit into the path; the errors of the others are zero.
        lengths: m.
    """

    translation: Float[Array, "starts lengths"]
    rotation: Float[Array, "starts lengths"]
    valid: Bool[Array, "starts lengths"]
    lengths: Float[Array, " lengths"]

    def ok(self) -> Bool[Array, ""]:
        """Whether the path is as long as the shortest stretch, so that there are any errors."""
        return jnp.any(self.valid)

    def translation_percent(self) -> Float[Array, ""]:
        """``t_err`` of the benchmark: the mean over all stretches, % of the distance."""
        return 100.0 * _mean(self.translation, self.valid)

    def rotation_deg_per_meter(self) -> Float[Array, ""]:
        """``r_err`` of the benchmark: the mean over all stretches, deg/m."""
        return jnp.rad2deg(_mean(self.rotation, self.valid))

    def translation_percent_by_length(self) -> Float[Array, " lengths"]:
        """The mean for each length, % of the distance; zero where no stretch fits."""
        return 100.0 * jax.vmap(_mean, in_axes=1)(self.translation, self.valid)

    def rotation_deg_per_meter_by_length(self) -> Float[Array, " lengths"]:
        """The mean for each length, deg/m; zero where no stretch fits."""
        return jnp.rad2deg(jax.vmap(_mean, in_axes=1)(self.rotation, self.valid))


def _mean(values: Float[Array, "*s"], valid: Bool[Array, "*s"]) -> Float[Array, ""]:
    return jnp.sum(values) / jnp.maximum(jnp.sum(valid), 1).astype(values.dtype)


@filter_jit
def segment_errors(
    estimate: Trajectory,
    truth: Trajectory,
    *,
    lengths: tuple[float, ...] | Float[Array, " lengths"] = KITTI_LENGTHS,
    step: int = 10,
) -> SegmentErrors:
    """The odometry metric of KITTI: errors of the motion over stretches of 100, 200, ... 800 m.

    From every tenth frame, a stretch ends at the first frame whose distance along the true path is greater than the
    length. The error is the difference of the estimated and the true motion, divided by the length. As in the
    benchmark's development kit, but for the angle, which is well conditioned here.

    Args:
        estimate: the estimated path.
        truth: the true path, pose by pose.
        lengths: m; shorter ones for short recordings, for example ``(5.0, 10.0, 15.0)``. Other numbers in an array
            need no new compilation.
        step: frames between the first frames of stretches.

    Returns:
        Errors of all stretches and their means.

    Raises:
        ValueError: when the paths have different numbers of poses.

    References:
        Geiger, Lenz and Urtasun, "Are we ready for autonomous driving?", CVPR 2012, and its development kit.

    Example:
        >>> import jaxloc as jl
        >>> path = jl.data.simulate.stereo_points.simulate_drive(60, key=jax.random.key(0))
        >>> errors = segment_errors(path, path, lengths=(10.0, 20.0))
        >>> bool(errors.ok()), bool(errors.translation_percent() < 1e-3)
        (True, True)
    """
    check_lengths(estimate, truth)
    count, dtype = len(truth), truth.times.dtype
    distances = path_distances(truth.positions)
    starts = jnp.arange(0, count, step)
    lengths_array = jnp.asarray(lengths, dtype)
    last = jnp.searchsorted(distances, distances[starts][:, None] + lengths_array[None], side="right")
    valid = last < count
    first = jnp.broadcast_to(starts[:, None], last.shape)
    difference = motion_differences(estimate, truth, first.ravel(), jnp.minimum(last, count - 1).ravel())
    squares = jnp.sum(difference.translation**2, axis=1)
    translation = jnp.where(squares > 0, jnp.sqrt(jnp.where(squares > 0, squares, 1.0)), 0.0)
    rotation = jax.vmap(rotation_angle)(difference.rotation.rotation_matrix)
    translation, rotation = (
        jnp.where(valid, values.reshape(last.shape) / lengths_array[None], 0.0) for values in (translation, rotation)
    )
    return SegmentErrors(translation, rotation, valid, lengths_array)


def fitting_lengths(length: float) -> tuple[float, ...]:
    """Lengths of stretches that suit a path: those of KITTI where they fit, eighths of half the path otherwise.

    Args:
        length: of the path, m.

    Returns:
        Lengths, m; none for a path of no length.

    Example:
        >>> fitting_lengths(40.0)
        (2.5, 5.0, 7.5, 10.0, 12.5, 15.0, 17.5, 20.0)
    """
    if length > KITTI_LENGTHS[0]:
        return tuple(value for value in KITTI_LENGTHS if value < length)
    return tuple(length * part / 16.0 for part in range(1, 9)) if length > 0 else ()


@filter_jit
def end_drift_percent(estimate: Trajectory, truth: Trajectory) -> Float[Array, ""]:
    """Position error at the end of the path, in % of the distance traveled, both paths starting from the same pose.

    Args:
        estimate: the estimated path.
        truth: the true path, pose by pose.

    Returns:
        Drift, %; zero for a path of no length, or without poses.

    Raises:
        ValueError: when the paths have different numbers of poses.

    Example:
        >>> import jaxloc as jl
        >>> path = jl.data.simulate.stereo_points.simulate_drive(20, key=jax.random.key(0))
        >>> bool(end_drift_percent(path, path) < 1e-3)
        True
    """
    curve = drift_curve_percent(estimate, truth)
    return curve[-1] if len(truth) else jnp.zeros((), curve.dtype)


@filter_jit
def drift_curve_percent(estimate: Trajectory, truth: Trajectory) -> Float[Array, " n"]:
    """:func:`end_drift_percent` of the path up to each pose.

    Args:
        estimate: the estimated path.
        truth: the true path, pose by pose.

    Returns:
        Drift at each pose, % of the distance up to there; zero where that is zero.

    Raises:
        ValueError: when the paths have different numbers of poses.

    Example:
        >>> import jaxloc as jl
        >>> path = jl.data.simulate.stereo_points.simulate_drive(20, key=jax.random.key(0))
        >>> drift_curve_percent(path, path).shape
        (20,)
    """
    check_lengths(estimate, truth)
    distances = path_distances(truth.positions)
    indices = jnp.arange(len(truth))
    difference = motion_differences(estimate, truth, jnp.zeros_like(indices), indices)
    squares = jnp.sum(difference.translation**2, axis=1)
    gaps = jnp.where(squares > 0, jnp.sqrt(jnp.where(squares > 0, squares, 1.0)), 0.0)
    return jnp.where(distances > 0, 100.0 * gaps / jnp.where(distances > 0, distances, 1.0), 0.0)
