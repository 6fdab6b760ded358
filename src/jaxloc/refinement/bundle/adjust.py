"""Bundle adjustment: cameras and points together, by Levenberg and Marquardt's method on the reduced system."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxloc import _tree as tree
from jaxloc.poses import SE3
from jaxloc.refinement.bundle.estimate import BundleEstimate
from jaxloc.refinement.bundle.gradient import attach_gradient
from jaxloc.refinement.bundle.problem import Bundle, BundleProblem, Gauge, Observations
from jaxloc.refinement.bundle.schur import Arrow, Tangent, eliminate, normal_equations
from jaxloc.refinement.bundle.structure import Structure
from jaxloc.sensors import Pinhole, StereoRig
from jaxloc.solvers import LevenbergMarquardt, Loss, Quadratic, Status
from jaxloc.solvers.least_squares import trusted


def adjust(
    model: Pinhole | StereoRig,
    start: Bundle,
    observations: Observations,
    *,
    gauge: Gauge | None = None,
    loss: Loss = Quadratic(),
    structure: Structure | None = None,
    solver: LevenbergMarquardt = LevenbergMarquardt(),
    max_steps: int = 100,
) -> BundleEstimate:
    """Poses of cameras and places of points that explain best what the cameras saw.

    Minimizes ``sum rho(|h(T_c^-1 X_p) - z|^2 / sigma^2)`` over all poses ``T_c = T_world_camera`` and points ``X_p``.
    Points are eliminated (Schur complement), so a step costs a dense factorization of six rows a camera, and time and
    memory linear in the pairs of cameras that share a point.

    Derivatives of the value by measurements, sigmas, the model and the gauge are those of the implicit function
    theorem with the exact Hessian, factored the same way: about one step's work each way. They are zero where ``ok``
    is False. In float32 a pose at the far end of a long chain keeps about three digits of its distance to the first,
    and weak chains may be flagged as undetermined: use float64 for covariances of more than some ten poses in a row.

    Args:
        model: the camera, or the rig, that took every image.
        start: poses and points to start from. A point with a start that is not finite is left out.
        observations: what was seen.
        gauge: what holds the bundle in place; by default the first camera is fixed, which suits a stereo rig. For a
            single camera the scale needs a hold too: fix two cameras, or give a prior.
        loss: robust kernel over the components of an observation, in sigmas.
        structure: tables of `Structure.of`, made here where not given. Needed under jit, since they are made on the
            host from concrete numbers.
        solver: tolerance and initial damping; its linear solver is not used.
        max_steps: bound on the number of steps; static.

    Returns:
        The estimate, with covariances of poses and points on demand. ``ok`` is False when it has not converged, when
        directions of the cameras are undetermined (a free gauge, a camera without sights), when under plain least
        squares a point lies behind a camera that sees it, or when the start of a pose is not finite. Points with too
        few rays (one of a single camera) do not count and keep their start; ``point_ok`` tells.

    Raises:
        ValueError: shapes that do not fit.

    References:
        Triggs et al., "Bundle adjustment: a modern synthesis", 2000. Nielsen, "Damping parameter in Marquardt's
        method", 1999. Exact implicit derivatives [K-21, K-71].

    Example:
        >>> import jax, jax.numpy as jnp, jaxloc as jl
        >>> from jaxloc.refinement.bundle import Bundle, Observations, adjust
        >>> rig = jl.sensors.StereoRig(jl.sensors.Pinhole(500.0, 500.0, 320.0, 240.0), baseline=0.5)
        >>> points = jnp.array([[0.0, 0.0, 5.0], [1.0, 0.0, 6.0], [0.0, 1.0, 7.0], [1.0, 1.0, 5.0]])
        >>> poses = jax.vmap(lambda x: jl.poses.SE3.from_euler(x, 0.0, 0.0, 0.0))(0.3 * jnp.eye(3)[:2])
        >>> seen = jax.vmap(lambda pose: rig.project(pose.inverse().apply(points)))(poses).reshape(-1, 3)
        >>> sights = Observations.of(jnp.repeat(jnp.arange(2), 4), jnp.tile(jnp.arange(4), 2), seen)
        >>> fit = adjust(rig, Bundle(poses, points + 0.1), sights)
        >>> bool(fit.ok), bool(jnp.allclose(fit.value.points, points, atol=1e-3))
        (True, True)
    """
    cameras, points = _sizes(model, start, observations)
    gauge = Gauge.fix(cameras, 0) if gauge is None else gauge
    if gauge.fixed.shape[0] != cameras:
        raise ValueError(f"The gauge is of {gauge.fixed.shape[0]} cameras, but the bundle has {cameras}.")
    if structure is None:
        index = observations.camera, observations.point
        structure = Structure.of(*index, num_cameras=cameras, num_points=points)
    setup = _Setup(model, observations, gauge, loss, solver)
    return _adjust(setup, start, structure, max_steps)


def _sizes(model: Any, start: Bundle, observations: Observations) -> tuple[int, int]:
    came, wanted = observations.measured.shape[1], 3 if isinstance(model, StereoRig) else 2
    if came != wanted:
        raise ValueError(f"Observations have {came} components, but a {type(model).__name__} gives {wanted}.")
    if len(start.poses.batch_shape) != 1:
        raise ValueError(f"The poses have batch shape {start.poses.batch_shape}: needs a stack of poses, one a camera.")
    return start.poses.batch_shape[0], start.points.shape[0]


class _Setup(NamedTuple):
    model: Pinhole | StereoRig
    observations: Observations
    gauge: Gauge
    loss: Loss
    solver: LevenbergMarquardt


@eqx.filter_jit
def _adjust(setup: _Setup, start: Bundle, structure: Structure, max_steps: int) -> BundleEstimate:
    problem = BundleProblem.of(setup.model, start, setup.observations, setup.gauge, setup.loss)
    detached = jax.tree.map(lambda leaf: jax.lax.stop_gradient(leaf), (problem, start))
    clean, begun = _finite_start(detached[1])
    ended = _iterate(detached[0], begun, structure, setup.solver, max_steps)
    conclusion = _conclude(detached[0], structure, ended, clean)
    ok = conclusion.status == int(Status.CONVERGED)
    problem = trusted(problem, ok)
    value = attach_gradient(conclusion.value, problem, structure, ok)
    cost = problem.cost(value)
    return BundleEstimate(
        value=value,
        cost=jnp.where(jnp.isfinite(cost), cost, 0.0),
        ok=ok,
        num_steps=ended.steps,
        status=conclusion.status,
        point_ok=conclusion.point_ok,
        problem=problem,
        structure=structure,
    )


def _finite_start(start: Bundle) -> tuple[Bool[Array, ""], Bundle]:
    """Whether the poses are finite, and the start with anything that is not replaced."""
    flat = jax.vmap(lambda pose: pose.matrix())(start.poses)
    good = jnp.all(jnp.isfinite(flat), axis=(1, 2))
    neutral = SE3.identity(start.points.dtype)
    poses = jax.tree.map(
        lambda leaf, rest: jnp.where(good.reshape(-1, *([1] * rest.ndim)), leaf, rest[None]), start.poses, neutral
    )
    return jnp.all(good), Bundle(poses, jnp.where(jnp.isfinite(start.points), start.points, 0.0))


class _State(NamedTuple):
    value: Bundle
    damping: Float[Array, ""]
    growth: Float[Array, ""]
    steps: Int[Array, ""]
    near: Bool[Array, ""]
    done: Bool[Array, ""]


def _iterate(
    problem: BundleProblem, start: Bundle, structure: Structure, solver: LevenbergMarquardt, max_steps: int
) -> _State:
    """Damped steps, never uphill."""
    dtype = start.points.dtype
    rtol = solver.rtol if solver.rtol is not None else 10.0 * float(jnp.finfo(dtype).eps)
    as_float = lambda number: jnp.asarray(number, dtype)  # noqa: E731

    def step(state: _State) -> _State:
        before, gradient, arrow = normal_equations(problem, state.value, structure, near=state.near)
        delta = eliminate(arrow, structure, state.damping).solve(_negative(gradient))
        predicted = -0.5 * gradient.dot(delta) + 0.5 * state.damping * _weighted(arrow, delta)
        moved = state.value.moved(delta.cameras, delta.points)
        cost = problem.cost(moved)
        gain = (before - cost) / jnp.maximum(predicted, jnp.finfo(dtype).tiny)
        better = (cost < before) & (gain > 0)
        value = tree.where(better, moved, state.value)
        shrink = jnp.clip(1.0 - (2.0 * gain - 1.0) ** 3, 0.1, 1.0)
        damping = jnp.where(better, state.damping * shrink, state.damping * state.growth)
        small = (predicted <= rtol * before) | (damping > 1.0 / jnp.finfo(dtype).eps)
        growth = jnp.where(better, as_float(2.0), 2.0 * state.growth)
        return _State(value, damping, growth, state.steps + 1, predicted < 1.0, small)

    numbers = as_float(solver.initial_damping), as_float(2.0)
    first = _State(start, *numbers, jnp.array(0), jnp.array(False), jnp.array(False))
    return jax.lax.while_loop(lambda state: ~state.done & (state.steps < max_steps), step, first)


def _negative(tangent: Tangent) -> Tangent:
    return jax.tree.map(lambda leaf: -leaf, tangent)


def _weighted(arrow: Arrow, delta: Tangent) -> Float[Array, ""]:
    """Squared length of a step in the units of the diagonal."""
    diagonal = arrow.diagonal()
    return jnp.sum(diagonal.cameras * delta.cameras**2) + jnp.sum(diagonal.points * delta.points**2)


class _Conclusion(NamedTuple):
    value: Bundle
    status: Int[Array, ""]
    point_ok: Bool[Array, " n"]


def _conclude(problem: BundleProblem, structure: Structure, ended: _State, clean: Bool[Array, ""]) -> _Conclusion:
    """The last step, undamped and too small to need another evaluation, and how it ended."""
    cost, gradient, arrow = normal_equations(problem, ended.value, structure)
    eliminated = eliminate(arrow, structure)
    delta = eliminated.solve(_negative(gradient))
    moved = ended.value.moved(delta.cameras, delta.points)
    small = -gradient.dot(delta) <= 1e-6 * cost
    usual = ended.done & ~eliminated.deficient & small
    value = tree.where(usual, moved, ended.value)
    rays = structure.by_point.sum(problem.usable.astype(cost.dtype)[:, None])[:, 0]
    status = jnp.where(ended.done, int(Status.CONVERGED), int(Status.MAX_STEPS))
    status = jnp.where(problem.admissible(value), status, int(Status.INADMISSIBLE))
    status = jnp.where(eliminated.deficient, int(Status.RANK_DEFICIENT), status)
    finite = clean & jnp.isfinite(cost) & jnp.all(jnp.isfinite(arrow.cameras))
    status = jnp.where(finite, status, int(Status.NONFINITE))
    return _Conclusion(value, status, (rays > 0) & ~eliminated.lost)
