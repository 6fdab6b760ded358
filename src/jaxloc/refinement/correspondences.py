"""Pose estimation from mixed correspondences of points, lines and segments, in the plane and in space.

Features of a source frame are mapped to the target frame by ``T = T_target_source`` and compared with their matches
there. Each kind of pair has a difference vector, some directions of which are used:

| pair | residual | dofs in the plane | in space |
|---|---|---|---|
| point to point | all of ``T s - t`` | 2 | 3 |
| point to line | the part of ``T s - p`` across the line | 1 | 2 |
| point to segment | vector to the nearest point, ends included | 1 (2 beyond an end) | 2 (3) |
| segment to segment | both ends of the source across the target's line | 2 | 4 |
| line to line | the sine of the angle between the directions | 1 | 2 |

Detected segments end at arbitrary points, so their ends give no constraint along them: in the plane the distance across
and the angle remain, two dofs. Lines without ends constrain the angle; where the position of a line is known too, any
of its points is a point-to-line pair. Known end points are point-to-point pairs.

References:
    A. Kelly, *Mobile Robotics*, lecture 9.2.3.4, four kinds of planar correspondences [K-56, K-57]; 9.2.3.7 for the
    nearest point of a segment [K-63].
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxloc._arguments import checked
from jaxloc._jit import filter_jit
from jaxloc.poses import SE2, SE3
from jaxloc.refinement.feature_pairs import (
    LineLine,
    Pairs,
    PointLine,
    PointPoint,
    PointSegment,
    SegmentSegment,
    nearest_on_segment,
)
from jaxloc.solvers import Estimate, LevenbergMarquardt, Linearization, Problem, Quadratic, Solver, solve
from jaxloc.solvers.estimate import guarded

__all__ = [
    "Correspondences",
    "LineLine",
    "Mixed",
    "Pairs",
    "PointLine",
    "PointPoint",
    "PointSegment",
    "SegmentSegment",
    "nearest_on_segment",
    "refine",
]


class Correspondences(eqx.Module):
    """Matched features of all kinds; kinds that are missing are None.

    Attributes:
        point_point: points and points.
        point_line: points and lines.
        point_segment: points and segments.
        segment_segment: segments and segments.
        line_line: lines and lines.
    """

    point_point: PointPoint | None = None
    point_line: PointLine | None = None
    point_segment: PointSegment | None = None
    segment_segment: SegmentSegment | None = None
    line_line: LineLine | None = None

    def kinds(self) -> tuple[Pairs, ...]:
        """The kinds that are present, in the order of the fields.

        Raises:
            ValueError: there are none.
        """
        fields = (self.point_point, self.point_line, self.point_segment, self.segment_segment, self.line_line)
        present = tuple(pairs for pairs in fields if pairs is not None)
        if not present:
            raise ValueError("Correspondences without any pairs: give at least one kind.")
        return present


class Mixed(Problem):
    """Least-squares problem of mixed correspondences; the state is the pose ``T_target_source``, `SE2` or `SE3` [K-57].

    Attributes:
        correspondences: the pairs.
        loss: robust kernel over the components of a pair: one for all, or a tuple with one for each kind present.
    """

    correspondences: Correspondences
    loss: Any = Quadratic()

    def residual(self, state: SE2 | SE3) -> tuple[Float[Array, "c n"], ...]:
        """Whitened differences of each kind."""
        return self.linearize(state).residual

    def linearize(self, state: SE2 | SE3) -> Linearization:
        """Differences and Jacobians in closed form."""
        parts = [pairs.linearize(state) for pairs in self.correspondences.kinds()]
        return Linearization(tuple(part.residual for part in parts), tuple(part.jacobian for part in parts))


@filter_jit
@checked
def refine(
    correspondences: Correspondences,
    initial: SE2 | SE3,
    *,
    loss: Any = Quadratic(),
    solver: Solver = LevenbergMarquardt(),
) -> Estimate:
    """Pose that maps features of a source frame onto their matches in a target frame.

    Minimizes ``sum rho(|r_k(T)|^2)`` over ``T = T_target_source`` with the whitened differences of all pairs.

    Args:
        correspondences: pairs of any kinds; masked pairs may hold any numbers, nan too.
        initial: ``T_target_source``: `SE2` for features of the plane, `SE3` for those of space.
        loss: robust kernel, or one for each kind present.
        solver: of the minimization.

    Returns:
        Estimate of the pose, covariance in its tangent. ``ok`` is False when the pairs do not determine it, as lines
        that are all parallel.

    Raises:
        ValueError: no pairs, or features and pose of different dimension.

    References:
        KELLY 9.2.3.4, 9.2.4.2 [K-57, K-73]. Source and target are exchanged by the inverse pose [K-15].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> from jaxloc.refinement.correspondences import Correspondences, LineLine, PointPoint, refine
        >>> truth = jl.poses.SE2(1.0, 2.0, 0.5)
        >>> point, wall = jnp.array([[2.0, 1.0]]), jnp.array([[1.0, 0.0]])
        >>> turned = truth.rotation.apply(wall)
        >>> pairs = Correspondences(PointPoint(point, truth.apply(point)), line_line=LineLine(wall, turned))
        >>> fit = refine(pairs, jl.poses.SE2(0.0, 0.0, 0.0))
        >>> bool(fit.ok), round(float(fit.value.theta), 3), round(float(fit.value.x), 3)
        (True, 0.5, 1.0)
    """
    size = initial.translation.shape[-1]
    for pairs in correspondences.kinds():
        found = jax.tree.leaves(pairs)[0].shape[0]
        if found != size:
            raise ValueError(f"{type(pairs).__name__} holds features of {found} coordinates, the pose has {size}.")

    def run(correspondences: Correspondences, initial: SE2 | SE3, loss: Any) -> Estimate:
        return solve(Mixed(correspondences, loss), initial, solver=solver)

    return guarded(jnp.array(True), run, correspondences, initial, loss)
