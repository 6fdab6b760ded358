import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.poses import SE2, SE3, local
from jaxloc.solvers import (
    QR,
    Cauchy,
    Dogleg,
    FunctionProblem,
    GaussNewton,
    GemanMcClure,
    LevenbergMarquardt,
    Quadratic,
    Status,
    solve,
)

POINTS = 30
TRUTH = np.array([0.5, -0.2, 0.3, 0.2, 0.4, -0.3])


def alignment(pose, data):
    return (pose.apply(data["source"]) - data["target"]).T / data["sigma"] * data["mask"][None, :]


def noisy_alignment(rng, dtype=np.float64, outliers=0.0):
    source = rng.normal(size=(POINTS, 3))
    truth = np.asarray(SE3.exp(jnp.asarray(TRUTH, dtype)).matrix(), float)
    target = source @ truth[:3, :3].T + truth[:3, 3] + 0.05 * rng.normal(size=(POINTS, 3))
    count = int(outliers * POINTS)
    target[:count] += rng.uniform(-3.0, 3.0, (count, 3))
    arrays = {"mask": np.ones(POINTS), "sigma": 0.05, "source": source, "target": target}
    return {name: jnp.asarray(value, dtype) for name, value in arrays.items()}


def near_truth(dtype=np.float64):
    return SE3.exp(jnp.asarray(TRUTH + 0.05, dtype))


@eqx.filter_jit
def fit_points(data, loss, initial, solver=GaussNewton()):
    return solve(FunctionProblem(alignment, data, loss), initial, solver=solver)


def kabsch(source, target):
    s, t = source - source.mean(0), target - target.mean(0)
    u, _, vt = np.linalg.svd(t.T @ s)
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return rotation, target.mean(0) - rotation @ source.mean(0)


SOLVERS = {
    "gauss_newton": GaussNewton(),
    "levenberg_marquardt": LevenbergMarquardt(),
    "dogleg": Dogleg(),
    "gauss_newton_qr": GaussNewton(linear_solver=QR()),
    "levenberg_marquardt_qr": LevenbergMarquardt(linear_solver=QR()),
    "dogleg_qr": Dogleg(linear_solver=QR()),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["gauss_newton", "levenberg_marquardt", "dogleg_qr"])
def test_optimum_equals_kabsch_from_far(name, dtype, rng):  # K-48, K-71
    data = noisy_alignment(rng, dtype)
    found = fit_points(data, Quadratic(), SE3.identity(dtype), SOLVERS[name])
    rotation, translation = kabsch(np.asarray(data["source"], float), np.asarray(data["target"], float))
    tolerance = 1e-10 if dtype == np.float64 else 2e-6
    assert bool(found.ok) and int(found.num_steps) <= 12
    assert found.value.translation.dtype == found.covariance.dtype == found.cost.dtype == dtype
    assert np.abs(found.value.rotation.matrix() - rotation).max() < tolerance
    assert np.abs(found.value.translation - translation).max() < tolerance


def with_prior(state, data):
    """A pose and a bias in one pytree, beside an integer that does not move."""
    seen = state["pose"].apply(data["source"]) + state["bias"][None, :]
    return {"points": (seen - data["target"]).T / data["sigma"], "prior": (state["bias"] - 0.1) / 0.02}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["levenberg_marquardt", "dogleg", "gauss_newton_qr", "levenberg_marquardt_qr"])
def test_solvers_agree_on_a_pytree_with_two_kernels(name, x64, rng):
    data = noisy_alignment(rng, outliers=0.2)
    problem = FunctionProblem(with_prior, data, {"points": Cauchy(2.0), "prior": Quadratic()})
    initial = {"bias": jnp.zeros(3), "frame": jnp.array(7), "pose": near_truth()}
    reference = solve(problem, initial)
    found = solve(problem, initial, solver=SOLVERS[name])
    assert bool(reference.ok) and bool(found.ok) and int(found.value["frame"]) == 7
    assert np.abs(local(reference.value, found.value)).max() < 1e-8
    np.testing.assert_allclose(found.covariance, reference.covariance, atol=1e-9)


# Made where they are used: their scales take the dtype of the day.
LOSSES = {"quadratic": Quadratic, "cauchy": Cauchy, "geman_mcclure": GemanMcClure}


def moved(data, direction, step):
    return jax.tree.map(lambda x, d: x + step * d, data, direction)


def summary(data, loss):
    """A scalar of the solution that all of the pose enters."""
    value = fit_points(data, loss, near_truth(data["target"].dtype)).value
    weights = jnp.sin(jnp.arange(6.0, dtype=data["target"].dtype))
    return jnp.sum(weights * value.log())


@eqx.filter_jit
def first_derivatives(data, direction, loss):
    value, push = jax.jvp(lambda d: summary(d, loss), (data,), (direction,))
    return value, push, jax.grad(lambda d: summary(d, loss))(data)


def directions(data, rng):
    step = {name: jnp.asarray(rng.normal(size=np.shape(x)), data["target"].dtype) for name, x in data.items()}
    step["mask"] = jnp.zeros_like(data["mask"])
    step["sigma"] = 0.05 * step["sigma"]
    return step


def inner(a, b):
    return sum(float(jnp.sum(x * y)) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


@pytest.mark.slow
@pytest.mark.parametrize("name", LOSSES)
def test_gradient_equals_differences(name, x64, rng):
    data, loss = noisy_alignment(rng, outliers=0.3), LOSSES[name]()
    direction = directions(data, rng)
    found = fit_points(data, loss, near_truth())
    assert bool(found.ok) and int(found.num_steps) <= 12
    _, forward, gradient = first_derivatives(data, direction, loss)
    np.testing.assert_allclose(inner(gradient, direction), forward, rtol=1e-11)
    step = 2e-4  # of fourth order: the solver leaves some 1e-12 that a smaller step would amplify
    at = {k: float(summary(moved(data, direction, k * step), loss)) for k in (-2, -1, 1, 2)}
    difference = (8.0 * (at[1] - at[-1]) - (at[2] - at[-2])) / (12.0 * step)
    assert abs(difference - float(forward)) <= 1e-7 * abs(float(forward))


@pytest.mark.slow
def test_single_precision_gradient(rng):
    loss = LOSSES["geman_mcclure"]
    with jax.enable_x64(True):
        data = noisy_alignment(rng, outliers=0.3)
        expected = jax.tree.map(np.asarray, first_derivatives(data, directions(data, rng), loss())[2])
    single = {key: jnp.asarray(np.asarray(x), jnp.float32) for key, x in data.items()}
    gradient = first_derivatives(single, jax.tree.map(jnp.zeros_like, single), loss())[2]
    for key in ("source", "target"):
        assert gradient[key].dtype == np.float32
        error = np.linalg.norm(gradient[key] - expected[key]) / np.linalg.norm(expected[key])
        assert error < 1e-4


@pytest.mark.slow
def test_second_derivative_equals_differences_of_the_first(x64, rng):
    data = noisy_alignment(rng, outliers=0.3)
    direction = directions(data, rng)

    @jax.jit
    def slope(step):
        return jax.jvp(lambda s: summary(moved(data, direction, s), LOSSES["cauchy"]()), (step,), (jnp.ones(()),))[1]

    curvature = jax.jit(jax.grad(slope))(jnp.zeros(()))
    step = 1e-5
    difference = (slope(jnp.array(step)) - slope(jnp.array(-step))) / (2 * step)
    assert abs(float(difference - curvature)) <= 1e-6 * abs(float(curvature))


@pytest.mark.slow
def test_covariance_is_differentiable(x64, rng):
    data = noisy_alignment(rng, outliers=0.3)
    direction = directions(data, rng)
    size = eqx.filter_jit(lambda d: jnp.trace(fit_points(d, LOSSES["cauchy"](), near_truth()).covariance))
    _, slope = jax.jvp(size, (data,), (direction,))
    step = 1e-5
    difference = (size(moved(data, direction, step)) - size(moved(data, direction, -step))) / (2 * step)
    assert abs(float(difference - slope)) <= 1e-5 * abs(float(slope))


@pytest.mark.slow
def test_vmap_equals_loop(x64, rng):
    batch = [noisy_alignment(rng, outliers=0.3) for _ in range(4)]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *batch)
    loss = LOSSES["cauchy"]()
    one = jax.jit(jax.value_and_grad(lambda d: summary(d, loss)))
    values, gradients = jax.jit(jax.vmap(jax.value_and_grad(lambda d: summary(d, loss))))(stacked)
    for i, data in enumerate(batch):
        value, gradient = one(data)
        np.testing.assert_allclose(values[i], value, rtol=1e-9)
        np.testing.assert_allclose(gradients["target"][i], gradient["target"], atol=1e-9)


@pytest.mark.slow
def test_masked_equals_absent(x64, rng):
    data = noisy_alignment(rng)
    masked = {**data, "mask": data["mask"].at[20:].set(0.0)}
    absent = {**data, **{name: data[name][:20] for name in ("mask", "source", "target")}}
    a, b = (fit_points(d, LOSSES["cauchy"](), near_truth()) for d in (masked, absent))
    np.testing.assert_allclose(a.value.matrix(), b.value.matrix(), atol=1e-12)
    np.testing.assert_allclose(a.covariance, b.covariance, rtol=1e-8, atol=1e-15)


def test_initial_value_has_no_derivative(x64, rng):
    data = noisy_alignment(rng)
    slope = jax.jacfwd(lambda d: fit_points(data, Quadratic(), near_truth().retract(d)).value.matrix())(jnp.zeros(6))
    assert not np.any(slope)


TWO_POINTS = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])


@pytest.mark.slow
@pytest.mark.parametrize("solver", [GaussNewton(), LevenbergMarquardt(), Dogleg()], ids=lambda s: type(s).__name__)
def test_two_points_leave_a_turn_about_their_line(solver):
    dtype = np.float32
    points = jnp.asarray(TWO_POINTS, dtype)
    data = {"mask": jnp.ones(2, dtype), "sigma": jnp.asarray(0.1, dtype), "source": points, "target": points}
    initial = SE3.exp(jnp.asarray([0.1, 0.0, -0.1, 0.0, 0.1, 0.05], dtype))
    found = fit_points(data, Quadratic(), initial, solver)
    assert not bool(found.ok) and int(found.status) == Status.RANK_DEFICIENT
    assert np.all(np.isfinite(found.covariance)) and np.abs(found.value.apply(points) - points).max() < 1e-5
    assert int(found.observability().rank) == 5
    message = found.describe()
    assert "1.00 rotation_x" in message and "rotation_y" not in message
    gradient = jax.jit(jax.grad(lambda d: fit_points(d, Quadratic(), initial, solver).value.translation[0]))(data)
    assert all(not np.any(leaf) for leaf in jax.tree.leaves(gradient))


TRACES = []


def counted(pose, data):
    TRACES.append(1)
    return alignment(pose, data)


def test_new_numbers_compile_nothing(rng):
    data = noisy_alignment(rng, np.float32)
    solve(FunctionProblem(counted, data, Cauchy(2.0)), near_truth(np.float32))
    count = len(TRACES)
    for scale in (1.5, 3.0):
        data = jax.tree.map(lambda x: 1.01 * x, data)
        solve(FunctionProblem(counted, data, Cauchy(scale)), near_truth(np.float32))
    assert count > 0 and len(TRACES) == count


@pytest.mark.slow
@pytest.mark.parametrize("place", ["target", "sigma", "initial"])
def test_numbers_that_are_not_finite(place, rng):
    dtype = np.float32
    data, initial = noisy_alignment(rng, dtype), near_truth(dtype)

    @jax.jit
    def everything(data):
        found = fit_points(data, Quadratic(), initial)
        return jnp.sum(found.value.matrix()) + jnp.trace(found.covariance) + found.cost + jnp.sum(found.information)

    if place == "target":
        data["target"] = data["target"].at[3, 1].set(jnp.nan)
    elif place == "sigma":
        data["sigma"] = jnp.asarray(0.0, dtype)
    else:
        initial = SE3.exp(jnp.full(6, jnp.nan, dtype))
    found = fit_points(data, Quadratic(), initial)
    assert not bool(found.ok) and int(found.status) == Status.NONFINITE and "nan" in found.describe()
    for leaf in (found.value.matrix(), found.covariance, found.cost, found.information):
        assert np.all(np.isfinite(leaf))
    gradient = jax.grad(everything)(data)
    assert all(not np.any(leaf) for leaf in jax.tree.leaves(gradient))


@pytest.mark.slow
def test_degenerate_lanes_leave_the_others_alone(x64, rng):
    good = noisy_alignment(rng)
    line = {**good, "source": good["source"] * jnp.array([[1.0, 0.0, 0.0]]), "target": good["target"] * 0.0}
    empty = {**good, "mask": jnp.zeros(POINTS)}
    bad = {**good, "target": good["target"].at[0, 0].set(jnp.nan)}
    batch = jax.tree.map(lambda *x: jnp.stack(x), good, line, empty, bad)

    def lane(data):
        found = fit_points(data, LOSSES["cauchy"](), near_truth())
        return jnp.sum(found.value.log()) + jnp.trace(found.covariance), found.ok

    (values, ok), gradients = jax.jit(jax.vmap(jax.value_and_grad(lane, has_aux=True)))(batch)
    assert ok.tolist() == [True, False, False, False] and np.all(np.isfinite(values))
    for leaf in jax.tree.leaves(gradients):
        assert np.all(np.isfinite(leaf)) and not np.any(leaf[1:])
    assert np.any(gradients["target"][0])


def test_too_few_steps(x64, rng):
    data = noisy_alignment(rng)
    found = solve(FunctionProblem(alignment, data), SE3.identity(), max_steps=2)
    assert not bool(found.ok) and int(found.status) == Status.MAX_STEPS and int(found.num_steps) == 2
    assert "max_steps" in found.describe()


def arctangent(x, data):
    return jnp.arctan(x - data)


def test_far_initial_values_need_damping(x64):
    """Newton's classic: full steps on an arctangent run away from starts beyond 1.39."""
    problem = FunctionProblem(arctangent, jnp.array([0.5]))
    assert not bool(solve(problem, jnp.array([4.5])).ok)
    for solver in (LevenbergMarquardt(), Dogleg()):
        found = solve(problem, jnp.array([4.5]), solver=solver)
        assert bool(found.ok) and abs(float(found.value[0]) - 0.5) < 1e-9


def test_tolerance_can_be_loosened(x64, rng):
    data = noisy_alignment(rng)
    tight = fit_points(data, Quadratic(), SE3.identity())
    loose = fit_points(data, Quadratic(), SE3.identity(), GaussNewton(rtol=1e-2))
    assert int(loose.num_steps) < int(tight.num_steps)


def test_state_without_floats_is_refused():
    with pytest.raises(ValueError, match="nothing to move"):
        solve(FunctionProblem(arctangent, jnp.zeros(1)), {"n": 3})


def planar(pose, data):
    return (pose.inverse().apply(data["world"]) - data["seen"]).T / 0.1


@pytest.mark.slow
def test_plane_and_jit_equals_eager(x64, rng):
    truth = SE2(1.0, -0.5, 0.7)
    world = jnp.asarray(rng.normal(size=(6, 2)))
    data = {"seen": truth.inverse().apply(world), "world": world}
    found = solve(FunctionProblem(planar, data), SE2(0.0, 0.0, 0.0))
    np.testing.assert_allclose(found.value.matrix(), truth.matrix(), atol=1e-10)
    with jax.disable_jit():
        eager = solve(FunctionProblem(planar, data), SE2(0.9, -0.4, 0.6), max_steps=8)
    np.testing.assert_allclose(eager.value.matrix(), found.value.matrix(), atol=1e-9)
    np.testing.assert_allclose(eager.covariance, found.covariance, atol=1e-9)
