"""Stereo visual odometry: robust motion from matched stereo features."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from jaxloc._jit import filter_jit
from jaxloc.beliefs import gates
from jaxloc.multiview import p3p
from jaxloc.poses import SE3
from jaxloc.refinement import StereoMatches, StereoReprojection, motion_problem
from jaxloc.sensors import StereoRig
from jaxloc.solvers import (
    Candidates,
    Estimate,
    GemanMcClure,
    Problem,
    Quadratic,
    RobustEstimate,
    ransac,
    solve,
    solve_graduated,
)
from jaxloc.solvers.problem import items


class MotionOptions(eqx.Module):
    """Options of robust motion estimation.

    Attributes:
        hypotheses: P3P samples drawn beside the initial value.
        threshold: of an outlier, in sigmas of the three-component residual.
        kernel: scale of the Geman-McClure kernel, in sigmas.
        min_inliers: a motion with fewer inliers is not ok.
    """

    hypotheses: int = eqx.field(static=True, default=64)
    threshold: float = eqx.field(static=True, default=5.0)
    kernel: float = eqx.field(static=True, default=3.0)
    min_inliers: int = eqx.field(static=True, default=15)


@filter_jit
def estimate_motion(
    rig: StereoRig,
    matches: StereoMatches,
    initial: SE3,
    *,
    key: Key[Array, ""],
    options: MotionOptions = MotionOptions(),
) -> RobustEstimate:
    """Motion of a stereo rig between two frames, from matches with outliers.

    The best of the initial value and of many P3P samples starts a graduated robust refinement of the
    errors-in-variables problem; a last plain fit of the inliers gives value and covariance.

    Args:
        rig: the stereo rig.
        matches: measurements in both frames with covariances.
        initial: ``T_previous_current``, for example the last motion.
        key: random key.
        options: how.

    Returns:
        Estimate of ``T_previous_current``, and which matches agree with it; not ok when too few do.

    References:
        Scaramuzza and Fraundorfer, "Visual odometry", RAM 2011; Matthies and Shafer 1987 [K-77, K-86, K-87, T-72].

    Example:
        >>> import jax, jax.numpy as jnp, jaxloc as jl
        >>> rig = jl.data.simulate.stereo_points.kitti_rig()
        >>> drive = jl.data.simulate_stereo_points(key=jax.random.key(0), rig=rig, num_frames=2)
        >>> pair = jax.tree.map(lambda leaf: leaf[0], drive.pairs)
        >>> matches = jl.refinement.StereoMatches.of(pair.previous, pair.current, None, None, None)
        >>> found = jl.odometry.estimate_motion(rig, matches, jl.poses.SE3.identity(), key=jax.random.key(1))
        >>> bool(found.ok)
        True
    """
    initial_problem = motion_problem(rig, matches, initial, GemanMcClure(options.kernel))
    start = _best_start(rig, matches, initial_problem, initial, key, options)
    robust = motion_problem(rig, matches, start, GemanMcClure(options.kernel))
    rough = solve_graduated(robust, start, factors=(4.0, 2.0), max_steps=15).value
    rough = jax.tree.map(jax.lax.stop_gradient, rough)
    inliers = _agreeing(motion_problem(rig, matches, rough, robust.loss), rough, 0.999)
    final = motion_problem(rig, eqx.tree_at(lambda m: m.valid, matches, inliers), rough, Quadratic())
    estimate = solve(final, rough, max_steps=15)
    enough = jnp.sum(inliers) >= options.min_inliers
    return RobustEstimate(eqx.tree_at(lambda e: e.ok, estimate, estimate.ok & enough), inliers)


class _OffsetMotion(Problem):
    """A motion and a constant error of all disparities; the state is (``T_previous_current``, offset)."""

    rig: StereoRig
    matches: StereoMatches
    whitener: Float[Array, "3 3 n"]
    loss: Any

    def residual(self, state: tuple[SE3, Float[Array, ""]]) -> Float[Array, "3 n"]:
        pose, offset = state
        shift = offset * jnp.array([0.0, -1.0, 0.0], offset.dtype)[None]
        points = self.rig.triangulate(self.matches.previous + shift).T
        seen = StereoReprojection(
            self.rig, points, (self.matches.current + shift).T, self.whitener, self.matches.valid, self.loss
        )
        return seen.residual(pose)


@filter_jit
def estimate_disparity_offset(rig: StereoRig, matches: StereoMatches, motion: RobustEstimate) -> Estimate:
    """Estimates a constant offset of the disparities jointly with the motion (self-calibration).

    A disparity that is too small by a constant makes far points move too far. One motion determines the offset poorly;
    combine the estimates of many by their variances.

    Args:
        rig: the stereo rig.
        matches: measurements in both frames.
        motion: what `estimate_motion` found with them.

    Returns:
        Estimate of the pair (``T_previous_current``, what to add to disparities in px); the covariance is 7x7.
    """
    start = jax.tree.map(jax.lax.stop_gradient, motion.estimate.value)
    agreeing = eqx.tree_at(lambda m: m.valid, matches, motion.inliers & rig.has_depth(matches.previous))
    whitener = motion_problem(rig, agreeing, start, Quadratic()).whitener
    problem = _OffsetMotion(rig, agreeing, whitener, GemanMcClure(3.0))
    return solve(problem, (start, jnp.zeros_like(start.translation[0])), max_steps=15)


def _agreeing(problem: StereoReprojection, pose: SE3, probability: float) -> Bool[Array, " n"]:
    """Items whose residual the noise explains."""
    squared = jnp.sum(items(problem.residual(pose)) ** 2, axis=0)
    return problem.valid & gates.gate(squared, 3, probability)


def _best_start(
    rig: StereoRig,
    matches: StereoMatches,
    problem: StereoReprojection,
    initial: SE3,
    key: Key[Array, ""],
    options: MotionOptions,
) -> SE3:
    """The initial value, or the P3P sample if clearly more matches agree with it."""
    rays = rig.camera.bearing(matches.current[:, jnp.array([0, 2])])
    data = {"points": problem.points.T, "rays": rays}
    found = ransac(
        data,
        _poses_of_three,
        jax.tree_util.Partial(_distances, problem),
        sample_size=3,
        threshold=options.threshold,
        hypotheses=options.hypotheses,
        key=key,
        valid=problem.valid,
    )
    ratio = _distances(problem, initial, data) / options.threshold
    initial_cost = jnp.sum(jnp.where(problem.valid, jnp.minimum(ratio**2, 1.0), 0.0))
    sampled = found.ok & (found.score < 0.95 * initial_cost)
    return jax.tree.map(lambda a, b: jax.lax.stop_gradient(jnp.where(sampled, a, b)), found.model, initial)


def _poses_of_three(sample: Any) -> Candidates:
    poses = p3p(sample["rays"], sample["points"])
    return Candidates(poses.poses, poses.valid)


def _distances(problem: StereoReprojection, pose: SE3, data: Any) -> Float[Array, " n"]:
    del data
    return jnp.sqrt(jnp.sum(problem.residual(pose) ** 2, axis=0))
