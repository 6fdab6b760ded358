"""Bundle adjustment by Levenberg-Marquardt steps on the reduced camera system."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxloc import _tree as tree
from jaxloc._arguments import checked
from jaxloc._jit import filter_jit
from jaxloc.poses import SE3
from jaxloc.refinement.bundle.estimate import BundleEstimate
from jaxloc.refinement.bundle.gradient import BundleEquations
from jaxloc.refinement.bundle.problem import Bundle, BundleProblem, Gauge, Observations
from jaxloc.refinement.bundle.schur import Arrow, Tangent, eliminate, normal_equations
from jaxloc.refinement.bundle.structure import Structure
from jaxloc.sensors import Pinhole, StereoRig
from jaxloc.solvers import LevenbergMarquardt, Loss, Quadratic, Status
from jaxloc.solvers.implicit_gradient import attach_gradient


@checked
def adjust(
    model: Pinhole | StereoRig,
    initial: Bundle,
    observations: Observations,
    *,
    gauge: Gauge | None = None,
    loss: Loss = Quadratic(),
    structure: Structure | None = None,
    solver: LevenbergMarquardt = LevenbergMarquardt(),
    max_steps: int = 100,
) -> BundleEstimate:
    """Bundle adjustment: camera poses and points of the least reprojection error.

    Minimizes ``sum rho(|h(T_c^-1 X_p) - z|^2 / sigma^2)`` over all poses ``T_c = T_world_camera`` and points ``X_p``.
    Points are eliminated (Schur complement): a step costs a dense factorization of six rows a camera, and time and
    memory linear in the pairs of cameras that share a point.

    Derivatives of the value by measurements, sigmas, the model and the gauge are those of the implicit function
    theorem with the exact Hessian, factored in the same way: about the cost of a step. They are zero where ``ok``
    is False. In float32 a pose at the far end of a long chain has about three digits of its distance to the first,
    and weak chains may be flagged as undetermined: use float64 for covariances of more than some ten poses in a row.

    Args:
        model: the camera or the rig of all images.
        initial: poses and points. Points with a non-finite initial value are ignored.
        observations: measurements of the points.
        gauge: fixed poses or priors; by default the first camera is fixed, which suits a stereo rig. For a
            single camera the scale must be fixed too: fix two cameras, or give a prior.
        loss: robust kernel over the components of an observation, in sigmas.
        structure: tables of `Structure.of`, made here where not given. Needed under jit, since they are made on the
            host from concrete numbers.
        solver: tolerance and initial damping; its linear solver is not used.
        max_steps: bound on the number of steps; static.

    Returns:
        The estimate, with covariances of poses and points on demand. ``ok`` is False when it has not converged, when
        directions of the cameras are undetermined (a free gauge, a camera without observations), when under plain least
        squares a point lies behind a camera that observes it, or when an initial pose is not finite. Points with too
        few rays (one of a single camera) are ignored and keep their initial value; see ``point_ok``.

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
        >>> measured = jax.vmap(lambda pose: rig.project(pose.inverse().apply(points)))(poses).reshape(-1, 3)
        >>> observations = Observations.of(jnp.repeat(jnp.arange(2), 4), jnp.tile(jnp.arange(4), 2), measured)
        >>> fit = adjust(rig, Bundle(poses, points + 0.1), observations)
        >>> bool(fit.ok), bool(jnp.allclose(fit.value.points, points, atol=1e-3))
        (True, True)
    """
    cameras, points = _sizes(model, initial, observations)
    gauge = Gauge.fix(cameras, 0) if gauge is None else gauge
    if gauge.fixed.shape[0] != cameras:
        raise ValueError(f"The gauge is of {gauge.fixed.shape[0]} cameras, but the bundle has {cameras}.")
    if structure is None:
        index = observations.camera, observations.point
        structure = Structure.of(*index, num_cameras=cameras, num_points=points)
    setup = _Setup(model, observations, gauge, loss, solver)
    return _adjust(setup, initial, structure, max_steps)


def _sizes(model: Any, initial: Bundle, observations: Observations) -> tuple[int, int]:
    came, wanted = observations.measured.shape[1], 3 if isinstance(model, StereoRig) else 2
    if came != wanted:
        raise ValueError(f"Observations have {came} components, but a {type(model).__name__} gives {wanted}.")
    if len(initial.poses.batch_shape) != 1:
        raise ValueError(
            f"The poses have batch shape {initial.poses.batch_shape}: needs a stack of poses, one a camera."
        )
    return initial.poses.batch_shape[0], initial.points.shape[0]


class _Setup(NamedTuple):
    model: Pinhole | StereoRig
    observations: Observations
    gauge: Gauge
    loss: Loss
    solver: LevenbergMarquardt


@filter_jit
def _adjust(setup: _Setup, initial: Bundle, structure: Structure, max_steps: int) -> BundleEstimate:
    problem = BundleProblem.of(setup.model, initial, setup.observations, setup.gauge, setup.loss)
    detached = jax.tree.map(lambda leaf: jax.lax.stop_gradient(leaf), (problem, initial))
    clean, begun = _finite_initial(detached[1])
    ended = _iterate(detached[0], begun, structure, setup.solver, max_steps)
    conclusion = _conclude(detached[0], structure, ended, clean)
    ok = conclusion.status == int(Status.CONVERGED)
    problem = tree.detach_unless(ok, problem)
    value = attach_gradient(conclusion.value, BundleEquations(problem, structure), ok)
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


def _finite_initial(initial: Bundle) -> tuple[Bool[Array, ""], Bundle]:
    """Whether the poses are finite, and the initial value with non-finite numbers replaced."""
    flat = jax.vmap(lambda pose: pose.matrix())(initial.poses)
    good = jnp.all(jnp.isfinite(flat), axis=(1, 2))
    neutral = SE3.identity(initial.points.dtype)
    poses = jax.tree.map(
        lambda leaf, rest: jnp.where(good.reshape(-1, *([1] * rest.ndim)), leaf, rest[None]), initial.poses, neutral
    )
    return jnp.all(good), Bundle(poses, jnp.where(jnp.isfinite(initial.points), initial.points, 0.0))


class _State(NamedTuple):
    value: Bundle
    damping: Float[Array, ""]
    growth: Float[Array, ""]
    steps: Int[Array, ""]
    near: Bool[Array, ""]
    done: Bool[Array, ""]


def _iterate(
    problem: BundleProblem, initial: Bundle, structure: Structure, solver: LevenbergMarquardt, max_steps: int
) -> _State:
    """Levenberg-Marquardt steps; those that increase the cost are rejected."""
    dtype = initial.points.dtype
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
    first = _State(initial, *numbers, jnp.array(0), jnp.array(False), jnp.array(False))
    return jax.lax.while_loop(lambda state: ~state.done & (state.steps < max_steps), step, first)


def _negative(tangent: Tangent) -> Tangent:
    return jax.tree.map(lambda leaf: -leaf, tangent)


def _weighted(arrow: Arrow, delta: Tangent) -> Float[Array, ""]:
    """Squared length of a step, weighted by the diagonal."""
    diagonal = arrow.diagonal()
    return jnp.sum(diagonal.cameras * delta.cameras**2) + jnp.sum(diagonal.points * delta.points**2)


class _Conclusion(NamedTuple):
    value: Bundle
    status: Int[Array, ""]
    point_ok: Bool[Array, " n"]


def _conclude(problem: BundleProblem, structure: Structure, ended: _State, clean: Bool[Array, ""]) -> _Conclusion:
    """A last undamped step, too small to need another evaluation, and the status."""
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
    return _Conclusion(value, status, (rays > 0) & ~eliminated.undetermined)
