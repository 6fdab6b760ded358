"""Flow to twist [K-78, K-87...K-90]: a moved camera, NumPy's least squares and finite differences judge."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.poses import SE3, Direction
from jaxloc.refinement.motion_from_flow import (
    DirectionalFlow,
    FreeMotion,
    JointFlow,
    TwistAndDepths,
    interaction_matrix,
    motion_from_flow,
    rotation_from_flow,
    twist_from_flow,
)
from jaxloc.solvers import GemanMcClure, Status, solve
from jaxloc.solvers.problem import Problem, normal_equations

TWIST = np.array([0.3, -0.1, 0.9, 0.05, 0.12, -0.08])
COUNT, SIGMA = 40, 1e-3


def view(rng, dtype=np.float64, noise=0.0, half=0.7, count=COUNT, twist=TWIST, depths=(2.0, 10.0)):
    """Points, flow and depth; the flow by the textbook's formulas, one point at a time."""
    points, depth = rng.uniform(-half, half, (count, 2)), rng.uniform(*depths, count)
    v, w = twist[:3], twist[3:]
    flow = []
    for (x, y), z in zip(points, depth, strict=True):
        velocity = -v - np.cross(w, np.array([x, y, 1.0]) * z)  # of the point in the frame of the camera
        flow.append([(velocity[0] - x * velocity[2]) / z, (velocity[1] - y * velocity[2]) / z])
    flow = np.array(flow) + noise * rng.normal(size=(count, 2))
    return tuple(jnp.asarray(a, dtype) for a in (points, flow, depth))


def test_interaction_matrix_is_the_derivative_of_the_projection(x64, rng):
    points, _, depth = view(rng)
    places = jnp.concatenate([points, jnp.ones((COUNT, 1))], axis=1) * depth[:, None]

    def seen(xi):
        moved = SE3.exp(xi).inverse().apply(places)
        return moved[:, :2] / moved[:, 2:]

    np.testing.assert_allclose(interaction_matrix(points, depth), jax.jacfwd(seen)(jnp.zeros(6)), atol=1e-12)


def test_twist_equals_numpy(dtype, rng):  # K-78
    points, flow, depth = view(rng, dtype, SIGMA)
    found = twist_from_flow(points, flow, depth, sigma=SIGMA)
    matrix = np.asarray(interaction_matrix(points, depth), float).reshape(-1, 6)
    expected = np.linalg.lstsq(matrix, np.asarray(flow, float).reshape(-1), rcond=None)[0]
    assert bool(found.ok) and found.value.dtype == found.covariance.dtype == dtype
    single = dtype == np.float32
    np.testing.assert_allclose(found.value, expected, atol=2e-5 if single else 1e-10)
    np.testing.assert_allclose(
        found.covariance, SIGMA**2 * np.linalg.inv(matrix.T @ matrix), rtol=2e-2 if single else 1e-7, atol=1e-12
    )


def test_two_points_tell_no_twist_and_three_do(x64, rng):
    points, flow, depth = view(rng)
    for count, ok in ((2, False), (3, True)):
        found = twist_from_flow(points, flow, depth, valid=jnp.arange(COUNT) < count)
        assert bool(found.ok) == ok and np.all(np.isfinite(found.covariance))
    np.testing.assert_allclose(found.value, TWIST, atol=1e-8)


def test_twice_the_depth_is_twice_the_translation(x64, rng):  # K-88
    points, flow, depth = view(rng)
    again = interaction_matrix(points, 2.0 * depth) @ jnp.asarray(np.r_[2.0 * TWIST[:3], TWIST[3:]])
    np.testing.assert_allclose(again, flow, atol=1e-12)
    zero = jnp.zeros(COUNT)
    problem = JointFlow(points.T, flow.T, jnp.ones(COUNT), zero, zero)
    state = TwistAndDepths(jnp.asarray(TWIST), 1.0 / depth)
    hessian = np.asarray(normal_equations(problem, state).hessian)
    values, vectors = np.linalg.eigh(hessian)
    scale = np.r_[TWIST[:3], np.zeros(3), -1.0 / np.asarray(depth)]
    assert abs(values[0]) < 1e-12 * values[-1] and values[1] > 1e-6 * values[-1]
    assert abs(vectors[:, 0] @ scale) / np.linalg.norm(scale) > 1.0 - 1e-9
    # One depth by stereo resolves it.
    known = JointFlow(points.T, flow.T, jnp.ones(COUNT), 1.0 / depth, zero.at[0].set(1.0))
    assert np.linalg.eigvalsh(np.asarray(normal_equations(known, state).hessian))[0] > 1e-9 * values[-1]
    assert not bool(solve(problem, state).ok) and bool(solve(known, state).ok)


def test_rotation_does_not_know_depth(dtype, rng):  # K-89
    turning = np.r_[np.zeros(3), TWIST[3:]]
    points, flow, _ = view(rng, dtype, twist=turning)
    found = rotation_from_flow(points, flow, sigma=SIGMA)
    assert bool(found.ok)
    np.testing.assert_allclose(found.value, TWIST[3:], atol=1e-6)
    other = interaction_matrix(points, jnp.full(COUNT, 77.0, dtype)) @ jnp.asarray(turning, dtype)
    np.testing.assert_allclose(rotation_from_flow(points, other).value, TWIST[3:], atol=1e-6)


@pytest.mark.parametrize(
    "twist", [TWIST, -TWIST, np.array([1.0, 0.0, 0.0, 0.0, 0.2, 0.0])], ids=["ahead", "back", "side"]
)
def test_motion_without_depth(twist, rng):
    points, flow, _ = view(rng, np.float32, twist=twist)
    found = motion_from_flow(points, flow, sigma=SIGMA)
    assert bool(found.ok)
    np.testing.assert_allclose(found.value.direction.vector, twist[:3] / np.linalg.norm(twist[:3]), atol=1e-3)
    np.testing.assert_allclose(found.value.angular_velocity, twist[3:], atol=1e-4)


def test_closed_jacobian_equals_autodiff(x64, rng):
    points, flow, _ = view(rng, noise=0.05)
    problem = DirectionalFlow(points.T, flow.T, jnp.ones(COUNT))
    for vector in ([0.2, -0.3, 0.8], [0.5, 0.1, -0.9]):
        state = FreeMotion(Direction.from_vector(jnp.array(vector)), jnp.array([0.1, 0.0, -0.1]))
        mine, theirs = problem.linearize(state), Problem.linearize(problem, state)
        np.testing.assert_allclose(mine.residual, theirs.residual, atol=1e-12)
        np.testing.assert_allclose(mine.jacobian, theirs.jacobian, atol=1e-10)


def test_covariance_of_free_motion_is_that_of_the_joint_problem(x64, rng):
    """Eliminating depths loses nothing: the marginal of the full problem with its scale fixed."""
    points, flow, depth = view(rng)
    twist = TWIST / np.linalg.norm(TWIST[:3])
    twist[3:] = TWIST[3:]
    inverse = np.linalg.norm(TWIST[:3]) / np.asarray(depth)
    found = motion_from_flow(points, flow, sigma=SIGMA)
    zero = jnp.zeros(COUNT)
    problem = JointFlow(points.T, flow.T, jnp.full(COUNT, 1.0 / SIGMA), zero, zero)
    hessian = np.asarray(normal_equations(problem, TwistAndDepths(jnp.asarray(twist), jnp.asarray(inverse))).hessian)
    basis = np.zeros((6 + COUNT, 5 + COUNT))
    basis[:3, :2] = np.asarray(found.value.direction.basis())
    basis[3:, 2:] = np.eye(3 + COUNT)
    expected = np.linalg.inv(basis.T @ hessian @ basis)[:5, :5]
    np.testing.assert_allclose(found.covariance, expected, rtol=1e-4, atol=1e-10)


@eqx.filter_jit
def nees(points, flow, depth):
    truth = FreeMotion(Direction.from_vector(jnp.asarray(TWIST[:3], flow.dtype)), jnp.asarray(TWIST[3:], flow.dtype))

    def lane(points, flow, depth):
        whole = twist_from_flow(points, flow, depth, sigma=SIGMA)
        free = motion_from_flow(points, flow, sigma=SIGMA)
        squared = whole.gaussian().mahalanobis_squared(jnp.asarray(TWIST, flow.dtype))
        return squared, free.gaussian().mahalanobis_squared(truth), whole.ok & free.ok

    return jax.vmap(lane)(points, flow, depth)


def test_covariances_are_consistent(rng):
    views = [view(rng, np.float32, SIGMA) for _ in range(300)]
    whole, free, ok = nees(*(jnp.stack(x) for x in zip(*views, strict=True)))
    assert np.all(ok)
    assert 5.4 < float(np.mean(whole)) < 6.6 and 4.5 < float(np.mean(free)) < 5.55


def test_wide_views_tell_rotation_from_translation(x64, rng):  # K-90
    """Before a wall: points of many depths tell them apart by parallax too."""
    conditions = []
    for degrees in (10.0, 20.0, 40.0, 80.0, 120.0):
        half = np.tan(np.radians(degrees / 2))
        points, flow, depth = view(np.random.default_rng(1), half=half, count=200, depths=(4.9, 5.1))
        conditions.append(float(twist_from_flow(points, flow, depth, sigma=SIGMA).observability().condition))
    assert all(wide < 0.7 * narrow for narrow, wide in zip(conditions, conditions[1:], strict=False)), conditions
    assert conditions[0] > 100 * conditions[-1]


def test_outliers_and_masks(rng):
    points, flow, depth = view(rng, np.float32)
    spoiled = flow.at[:6].add(0.5)
    robust = twist_from_flow(points, spoiled, depth, sigma=SIGMA, loss=GemanMcClure(30.0))
    masked = motion_from_flow(points, spoiled.at[:6].set(jnp.nan), sigma=SIGMA)
    np.testing.assert_allclose(robust.value, TWIST, atol=0.05)
    np.testing.assert_allclose(masked.value.angular_velocity, TWIST[3:], atol=1e-4)


def degenerate(kind, rng):
    points, flow, depth = view(rng, twist=np.r_[np.zeros(3), TWIST[3:]] if "turn" in kind else TWIST, noise=0.0)
    if kind == "nan":
        flow = jnp.full_like(flow, jnp.nan)
    if kind == "one place":
        points, flow = jnp.tile(points[:1], (COUNT, 1)), jnp.tile(flow[:1], (COUNT, 1))
    if kind == "still":
        flow = jnp.zeros_like(flow)
    if kind == "noisy turn":
        flow = flow + 1e-3 * jnp.asarray(rng.normal(size=flow.shape))
    return points, flow, depth


@pytest.mark.slow
def test_gradients_and_degenerate_flows(x64, rng):
    """One program for all: what is degenerate is flagged and finite; what is not has the gradient of differences."""
    cases = [degenerate(kind, rng) for kind in ("nan", "one place", "still", "turn", "noisy turn")]
    good = view(rng, noise=SIGMA)
    direction = tuple(jnp.asarray(rng.normal(size=a.shape)) for a in good)
    cases += [tuple(a + s * d for a, d in zip(good, direction, strict=True)) for s in (0.0, 1e-6, -1e-6)]
    batch = [jnp.stack(x) for x in zip(*cases, strict=True)]
    weights = jnp.array([1.0, 0.7, -0.4, 0.3, 0.9, -0.2])

    def lane(points, flow, depth):
        free, whole = motion_from_flow(points, flow, sigma=SIGMA), twist_from_flow(points, flow, depth, sigma=SIGMA)
        turn = rotation_from_flow(points, flow, sigma=SIGMA)
        total = jnp.sum(weights * whole.value) + jnp.sum(weights[:3] * free.value.direction.vector)
        total = total + jnp.sum(weights[3:] * free.value.angular_velocity) + jnp.sum(turn.value)
        return total, (free.ok, whole.ok, free.status, jnp.sum(free.covariance) + jnp.sum(whole.covariance))

    run = jax.jit(jax.vmap(jax.value_and_grad(lane, argnums=(0, 1, 2), has_aux=True)))
    (values, (free, whole, status, spread)), gradients = run(*batch)
    assert free.tolist() == [False] * 5 + [True] * 3 and whole.tolist() == [False] * 2 + [True] * 6
    assert int(status[4]) == Status.INADMISSIBLE and np.all(np.isfinite(values)) and np.all(np.isfinite(spread))
    assert all(np.all(np.isfinite(g)) for g in gradients)
    expected = sum(float(jnp.sum(g[5] * d)) for g, d in zip(gradients, direction, strict=True))
    assert abs(float(values[6] - values[7]) / 2e-6 - expected) <= 1e-4 * abs(expected)
